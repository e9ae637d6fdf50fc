// One pass of a stable radix sort by eight bits: `radix_count`, `radix_scan`, `radix_scatter`.
//
// Blocks of BLOCK keys are counted and scattered one a workgroup. Within a block the rank of a key among equal digits
// comes from ballots, so it depends on nothing but the order of the keys.

struct Pass {
    shift: u32,
    kind: u32,  // 0: as many keys as Gaussians, 1: as many as pairs
    first: u32,  // 1: the items are the places of the keys
}

@group(0) @binding(0) var<storage, read> settings: Pass;
@group(0) @binding(1) var<storage, read> plan: Plan;
@group(0) @binding(2) var<storage, read> keys: array<u32>;
@group(0) @binding(3) var<storage, read> items: array<u32>;
@group(0) @binding(4) var<storage, read_write> histogram: array<u32>;  // digit by digit, a number for each block
@group(0) @binding(5) var<storage, read_write> totals: array<u32>;  // of each digit
@group(0) @binding(6) var<storage, read_write> sorted_keys: array<u32>;
@group(0) @binding(7) var<storage, read_write> sorted_items: array<u32>;

const BLOCK: u32 = 4096u;
const ROUNDS: u32 = 16u;

var<workgroup> bins: array<atomic<u32>, 256>;
var<workgroup> ballots: array<atomic<u32>, 64>;  // eight words of 32 invocations for each bit

fn length() -> u32 {
    return select(plan.pairs, plan.gaussians, settings.kind == 0u);
}

fn blocks() -> u32 {
    return (length() + BLOCK - 1u) / BLOCK;
}

@compute @workgroup_size(256)
fn radix_count(@builtin(local_invocation_index) own: u32, @builtin(workgroup_id) group: vec3<u32>) {
    atomicStore(&bins[own], 0u);
    workgroupBarrier();
    let n = length();
    for (var round = 0u; round < ROUNDS; round += 1u) {
        let k = group.x * BLOCK + round * 256u + own;
        if (k < n) {
            atomicAdd(&bins[(keys[k] >> settings.shift) & 255u], 1u);
        }
    }
    workgroupBarrier();
    if (group.x < blocks()) {
        histogram[own * blocks() + group.x] = atomicLoad(&bins[own]);
    }
}

// One workgroup a digit: where each block's keys of this digit begin among all keys of the digit.
@compute @workgroup_size(256)
fn radix_scan(@builtin(local_invocation_index) own: u32, @builtin(workgroup_id) group: vec3<u32>) {
    let many = blocks();
    let share = (many + 255u) / 256u;
    let begin = min(own * share, many);
    let end = min(begin + share, many);
    var sum = 0u;
    for (var k = begin; k < end; k += 1u) {
        sum += histogram[group.x * many + k];
    }
    let up_to = scan(own, sum);
    var place = up_to - sum;
    for (var k = begin; k < end; k += 1u) {
        let count = histogram[group.x * many + k];
        histogram[group.x * many + k] = place;
        place += count;
    }
    if (own == 255u) {
        totals[group.x] = up_to;
    }
}

@compute @workgroup_size(256)
fn radix_scatter(@builtin(local_invocation_index) own: u32, @builtin(workgroup_id) group: vec3<u32>) {
    let n = length();
    let many = blocks();
    let block = min(group.x, max(many, 1u) - 1u);
    let total = totals[own];
    let start = scan(own, total) - total + histogram[own * many + block];
    workgroupBarrier();
    sums[own] = start;
    let word = own / 32u;
    let bit = own % 32u;
    for (var round = 0u; round < ROUNDS; round += 1u) {
        let k = group.x * BLOCK + round * 256u + own;
        var key = 0xffffffffu;
        var item = k;
        if (k < n) {
            key = keys[k];
            if (settings.first == 0u) {
                item = items[k];
            }
        }
        let digit = (key >> settings.shift) & 255u;
        if (own < 64u) {
            atomicStore(&ballots[own], 0u);
        }
        workgroupBarrier();
        for (var b = 0u; b < 8u; b += 1u) {
            if (((digit >> b) & 1u) != 0u) {
                atomicOr(&ballots[8u * b + word], 1u << bit);
            }
        }
        workgroupBarrier();
        var rank = 0u;
        var same = 0u;
        for (var w = 0u; w < 8u; w += 1u) {
            var alike = 0xffffffffu;
            for (var b = 0u; b < 8u; b += 1u) {
                let vote = atomicLoad(&ballots[8u * b + w]);
                alike &= select(~vote, vote, ((digit >> b) & 1u) != 0u);
            }
            same += countOneBits(alike);
            if (w < word) {
                rank += countOneBits(alike);
            } else if (w == word) {
                rank += countOneBits(alike & ((1u << bit) - 1u));
            }
        }
        let place = sums[digit] + rank;
        workgroupBarrier();
        if (rank + 1u == same) {
            sums[digit] = place + 1u;
        }
        if (k < n) {
            sorted_keys[place] = key;
            sorted_items[place] = item;
        }
    }
}
