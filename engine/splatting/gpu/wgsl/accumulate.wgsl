// Sums of pixel features by blending weight, for every pair, then for every Gaussian (kernels/accumulate.py).
//
// One workgroup a tile. Of a batch of Gaussians every invocation finds its pixel's weight; then each invocation sums
// one channel of one Gaussian over the tile's pixels.

@group(0) @binding(0) var<storage, read> view: View;
@group(0) @binding(1) var<storage, read> records: array<vec4<f32>>;
@group(0) @binding(2) var<storage, read> tile_starts: array<u32>;
@group(0) @binding(3) var<storage, read> pair_of: array<u32>;
@group(0) @binding(4) var<storage, read> owner_of: array<u32>;
@group(0) @binding(5) var<storage, read> counts: array<u32>;
@group(0) @binding(6) var<storage, read> starts: array<u32>;
@group(0) @binding(7) var<storage, read> planes: array<f32>;
@group(0) @binding(8) var<storage, read> target_values: array<f32>;  // (H, W, CHUNK)
@group(0) @binding(9) var<storage, read_write> pair_sums: array<f32>;  // (pairs, CHUNK)
@group(0) @binding(10) var<storage, read_write> lifted: array<f32>;  // (N, CHUNK)

const CHUNK: u32 = 16u;
const BATCH: u32 = 16u;

var<workgroup> weights: array<f32, 4096>;
var<workgroup> batch: array<vec4<f32>, 32>;
var<workgroup> deepest: atomic<u32>;
var<workgroup> deepest_entry: u32;

@compute @workgroup_size(16, 16)
fn accumulate(@builtin(local_invocation_index) own: u32, @builtin(workgroup_id) group: vec3<u32>) {
    let x = group.x * TILE + own % TILE;
    let y = group.y * TILE + own / TILE;
    let pixel = vec2<f32>(f32(x) + 0.5, f32(y) + 0.5);
    let tile = group.y * view.columns + group.x;
    let begin = tile_starts[tile];
    let end = tile_starts[tile + 1u];
    var last = -1.0;
    if (own == 0u) {
        atomicStore(&deepest, 0u);
    }
    workgroupBarrier();
    if (x < view.width && y < view.height) {
        last = planes[5u * view.width * view.height + y * view.width + x];
        atomicMax(&deepest, u32(last));
    }
    workgroupBarrier();
    if (own == 0u) {
        deepest_entry = atomicLoad(&deepest);
    }
    let many = min(workgroupUniformLoad(&deepest_entry) + 1u, end - begin);
    for (var k = begin + many + own; k < end; k += 256u) {
        for (var c = 0u; c < CHUNK; c += 1u) {
            pair_sums[pair_of[k] * CHUNK + c] = 0.0;
        }
    }
    let g = own / CHUNK;
    let channel = own % CHUNK;
    var left = 1.0;
    for (var done = 0u; done < many; done += BATCH) {
        let taken = min(BATCH, many - done);
        workgroupBarrier();
        if (own < 2u * taken) {
            batch[own] = records[4u * owner_of[pair_of[begin + done + own / 2u]] + own % 2u];
        }
        workgroupBarrier();
        for (var k = 0u; k < taken; k += 1u) {
            let one = batch[2u * k];
            let two = batch[2u * k + 1u];
            let d = pixel - one.xy;
            let power = exponent(one, two, d);
            var weight = 0.0;
            if (power >= -LOG2_255 && f32(done + k) <= last) {
                weight = min(exp2(power), MAX_ALPHA) * left;
                left -= weight;
            }
            weights[256u * k + own] = weight;
        }
        workgroupBarrier();
        if (g < taken) {
            var sum = 0.0;
            for (var q = 0u; q < 256u; q += 1u) {
                let weight = weights[256u * g + q];
                if (weight > 0.0) {
                    let at = (group.y * TILE + q / TILE) * view.width + group.x * TILE + q % TILE;
                    sum += weight * target_values[at * CHUNK + channel];
                }
            }
            pair_sums[pair_of[begin + done + g] * CHUNK + channel] = sum;
        }
    }
}

// One invocation a Gaussian and channel of the chunk.
@compute @workgroup_size(256)
fn gather(@builtin(global_invocation_id) id: vec3<u32>, @builtin(num_workgroups) groups: vec3<u32>) {
    let k = id.x + id.y * groups.x * 256u;
    let i = k / CHUNK;
    if (i >= view.count) {
        return;
    }
    var sum = 0.0;
    for (var pair = starts[i]; pair < starts[i] + counts[i]; pair += 1u) {
        sum += pair_sums[pair * CHUNK + k % CHUNK];
    }
    lifted[k] = sum;
}
