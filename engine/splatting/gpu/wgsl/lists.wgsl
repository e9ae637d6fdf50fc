// The pairs of Gaussians and tiles, in the order of depth; then where each tile's list begins.

@group(0) @binding(0) var<storage, read> view: View;
@group(0) @binding(1) var<storage, read_write> plan: Plan;
@group(0) @binding(2) var<storage, read> order: array<u32>;  // Gaussians by depth
@group(0) @binding(3) var<storage, read> counts: array<u32>;
@group(0) @binding(4) var<storage, read_write> block_sums: array<u32>;
@group(0) @binding(5) var<storage, read_write> starts: array<u32>;  // where each Gaussian's pairs begin

const BLOCK: u32 = 4096u;
const SHARE: u32 = 16u;

fn own_sum(group: u32, own: u32) -> u32 {
    var sum = 0u;
    for (var k = 0u; k < SHARE; k += 1u) {
        let rank = group * BLOCK + own * SHARE + k;
        if (rank < view.count) {
            sum += counts[order[rank]];
        }
    }
    return sum;
}

@compute @workgroup_size(256)
fn offsets_sum(@builtin(local_invocation_index) own: u32, @builtin(workgroup_id) group: vec3<u32>) {
    let whole = scan(own, own_sum(group.x, own));
    if (own == 255u) {
        block_sums[group.x] = whole;
    }
}

// One workgroup: where each block begins, and what the next kernels have to do.
@compute @workgroup_size(256)
fn offsets_scan(@builtin(local_invocation_index) own: u32) {
    let many = (view.count + BLOCK - 1u) / BLOCK;
    let share = (many + 255u) / 256u;
    let begin = min(own * share, many);
    let end = min(begin + share, many);
    var sum = 0u;
    for (var k = begin; k < end; k += 1u) {
        sum += block_sums[k];
    }
    let up_to = scan(own, sum);
    var place = up_to - sum;
    for (var k = begin; k < end; k += 1u) {
        let count = block_sums[k];
        block_sums[k] = place;
        place += count;
    }
    if (own == 255u) {
        var pairs = up_to;
        if (plan.full == 0u) {
            plan.needed = pairs;
        }
        if (pairs > view.capacity) {
            plan.full = 1u;
        }
        if (plan.full != 0u) {
            pairs = 0u;
        }
        plan.pairs = pairs;
        let sorted = (pairs + BLOCK - 1u) / BLOCK;
        plan.blocks = vec3<u32>(sorted, 1u, 1u);
        let groups = (pairs + 255u) / 256u;
        let across = min(groups, 32768u);
        plan.entries = vec3<u32>(across, (groups + across - 1u) / max(across, 1u), 1u);
    }
}

@compute @workgroup_size(256)
fn offsets_write(@builtin(local_invocation_index) own: u32, @builtin(workgroup_id) group: vec3<u32>) {
    let sum = own_sum(group.x, own);
    var place = block_sums[group.x] + scan(own, sum) - sum;
    for (var k = 0u; k < SHARE; k += 1u) {
        let rank = group.x * BLOCK + own * SHARE + k;
        if (rank < view.count) {
            starts[order[rank]] = place;
            place += counts[order[rank]];
        }
    }
}
