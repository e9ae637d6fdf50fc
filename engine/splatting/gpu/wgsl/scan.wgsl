// Sums over the 256 invocations of a workgroup, up to and with the own one.

var<workgroup> sums: array<u32, 256>;

fn scan(own: u32, value: u32) -> u32 {
    sums[own] = value;
    workgroupBarrier();
    for (var away = 1u; away < 256u; away *= 2u) {
        var before = 0u;
        if (own >= away) {
            before = sums[own - away];
        }
        workgroupBarrier();
        sums[own] += before;
        workgroupBarrier();
    }
    return sums[own];
}
