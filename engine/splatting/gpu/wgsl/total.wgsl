// The sum over the 256 invocations of a workgroup, in a fixed order.

var<workgroup> parts: array<f32, 256>;

fn total(own: u32, value: f32) -> f32 {
    parts[own] = value;
    workgroupBarrier();
    for (var half = 128u; half > 0u; half /= 2u) {
        if (own < half) {
            parts[own] += parts[own + half];
        }
        workgroupBarrier();
    }
    let sum = parts[0];
    workgroupBarrier();
    return sum;
}
