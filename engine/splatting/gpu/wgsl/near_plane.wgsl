// The depth up to which nothing is drawn (render.near_plane): the quarter of the distances, as a power of two.

@group(0) @binding(0) var<storage, read> view: View;
@group(0) @binding(1) var<storage, read> values: array<f32>;
@group(0) @binding(2) var<storage, read_write> plan: Plan;

const LOOKED_AT: u32 = 10000u;
const NEAR: f32 = 0.2;
const NEAR_DISTANCE: f32 = 2.5;
const BINS: u32 = 128u;

var<workgroup> bins: array<atomic<u32>, 130>;  // 0 and 129: distances that are 0 or not finite

@compute @workgroup_size(256)
fn near_plane(@builtin(local_invocation_index) own: u32) {
    if (own < 130u) {
        atomicStore(&bins[own], 0u);
    }
    workgroupBarrier();
    let step = max((view.count + LOOKED_AT - 1u) / LOOKED_AT, 1u);
    let looked = (view.count + step - 1u) / step;
    for (var k = own; k < looked; k += 256u) {
        let i = k * step;
        let x = values[i] - view.camera[18];
        let y = values[view.count + i] - view.camera[19];
        let z = values[2u * view.count + i] - view.camera[20];
        let squared = x * x + y * y + z * z;
        var bin = 129u;
        if (squared == 0.0) {
            bin = 0u;
        } else if (squared < 1e37) {
            let power = i32(round(0.5 * log2(squared / (NEAR_DISTANCE * NEAR_DISTANCE))));
            bin = u32(clamp(power + 64, 1, 128));
        }
        atomicAdd(&bins[bin], 1u);
    }
    workgroupBarrier();
    if (own != 0u) {
        return;
    }
    plan.near = NEAR;
    plan.gaussians = view.count;
    let quarter = looked / 4u;
    var below = 0u;
    for (var bin = 0u; bin < 129u; bin += 1u) {
        below += atomicLoad(&bins[bin]);
        if (below > quarter) {
            if (bin > 0u) {
                plan.near = ldexp(NEAR, i32(bin) - 64);
            }
            break;
        }
    }
}
