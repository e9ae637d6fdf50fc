// Limits the size of every Gaussian to its distance from the middle of the cameras (densify.clamp_sizes).

@group(0) @binding(0) var<storage, read> view: View;
@group(0) @binding(1) var<storage, read> plan: Plan;
@group(0) @binding(2) var<storage, read_write> values: array<f32>;

@compute @workgroup_size(256)
fn hold(@builtin(global_invocation_id) id: vec3<u32>, @builtin(num_workgroups) groups: vec3<u32>) {
    let i = id.x + id.y * groups.x * 256u;
    if (i >= view.count || plan.full != 0u) {
        return;
    }
    let away = vec3<f32>(values[i], values[view.count + i], values[2u * view.count + i])
        - vec3<f32>(view.middle[0], view.middle[1], view.middle[2]);
    let most = log(max(sqrt(dot(away, away)), view.extent));
    for (var k = 0u; k < 3u; k += 1u) {
        let at = (LOG_SCALE + k) * view.count + i;
        values[at] = min(values[at], most);
    }
}
