// Gradient of blending: one workgroup a tile, back to front, the sums of every pair over its tile.
//
// Of a batch of Gaussians every invocation first finds its pixel's two numbers, v (the gradient of the exponent) and the
// blending weight. Then a group of 32 invocations takes a Gaussian each and sums over the tile's pixels, all in a fixed
// order and without atomics.

@group(0) @binding(0) var<storage, read> view: View;
@group(0) @binding(1) var<storage, read> records: array<vec4<f32>>;
@group(0) @binding(2) var<storage, read> tile_starts: array<u32>;
@group(0) @binding(3) var<storage, read> pair_of: array<u32>;
@group(0) @binding(4) var<storage, read> owner_of: array<u32>;
@group(0) @binding(5) var<storage, read> planes: array<f32>;  // as `blend` wrote them
@group(0) @binding(6) var<storage, read> gradients: array<f32>;  // (5, H, W) of red, green, blue, depth, alpha
@group(0) @binding(7) var<storage, read_write> moments: array<f32>;  // (pairs, 12), as kernels/project_backward.py
@group(0) @binding(8) var<storage, read> loads: array<f32>;  // (H, W) if view.load_share is not 0
@group(0) @binding(9) var<storage, read> load_total: array<f32>;  // mean, spread

const BATCH: u32 = 8u;
const MOMENTS: u32 = 12u;

var<workgroup> batch: array<vec4<f32>, 24>;
var<workgroup> shared_values: array<f32, 4096>;  // v and weight of 8 × 256; then the partial sums
var<workgroup> pushes: array<vec4<f32>, 256>;  // gradients of red, green, blue, depth
var<workgroup> load_pushes: array<f32, 256>;
var<workgroup> deepest: atomic<u32>;
var<workgroup> deepest_entry: u32;

// The part of v that comes from the loads: densification does not count it.
fn pull_of_load(one: vec4<f32>, two: vec4<f32>, d: vec2<f32>, push: f32, weight: f32) -> f32 {
    if (push == 0.0 || weight == 0.0) {
        return 0.0;
    }
    let power = exponent(one, two, d);
    let alpha = exp2(power);
    return select(push * alpha * SOFT / ((alpha + SOFT) * (alpha + SOFT)), 0.0, power >= LOG2_MAX_ALPHA);
}

@compute @workgroup_size(16, 16)
fn blend_backward(@builtin(local_invocation_index) own: u32, @builtin(workgroup_id) group: vec3<u32>) {
    let x = group.x * TILE + own % TILE;
    let y = group.y * TILE + own / TILE;
    let corner = vec2<f32>(f32(group.x * TILE) + 0.5, f32(group.y * TILE) + 0.5);
    let pixel = vec2<f32>(f32(x) + 0.5, f32(y) + 0.5);
    let inside = x < view.width && y < view.height;
    let size = view.width * view.height;
    let at = y * view.width + x;
    let tile = group.y * view.columns + group.x;
    let begin = tile_starts[tile];
    let end = tile_starts[tile + 1u];
    var push = vec4<f32>(0.0);
    var behind = 0.0;
    var left = 0.0;
    var last = -1.0;
    if (own == 0u) {
        atomicStore(&deepest, 0u);
    }
    workgroupBarrier();
    if (inside) {
        push = vec4<f32>(gradients[at], gradients[size + at], gradients[2u * size + at], 0.0);
        if (view.with_depth != 0u) {
            push.w = gradients[3u * size + at];
        }
        behind = view.background[0] * push.x + view.background[1] * push.y + view.background[2] * push.z
            - gradients[4u * size + at];
        left = planes[4u * size + at];
        last = planes[5u * size + at];
        atomicMax(&deepest, u32(last));
    }
    // Gradient of the loads' spread over their mean (losses.unevenness).
    var load_push = 0.0;
    if (inside && view.load_share > 0.0) {
        let mean = load_total[0];
        let spread = load_total[1];
        if (mean >= 1e-9 && spread >= 1e-9) {
            load_push = view.load_share * ((loads[at] - mean) / spread - spread / mean) / (f32(size) * mean);
        }
    }
    load_pushes[own] = load_push;
    pushes[own] = push;
    workgroupBarrier();
    if (own == 0u) {
        deepest_entry = atomicLoad(&deepest);
    }
    let many = min(workgroupUniformLoad(&deepest_entry) + 1u, end - begin);
    for (var k = begin + many + own; k < end; k += 256u) {
        for (var m = 0u; m < MOMENTS; m += 1u) {
            moments[pair_of[k] * MOMENTS + m] = 0.0;
        }
    }
    let g = own / 32u;
    let lane = own % 32u;
    for (var done = 0u; done < many; done += BATCH) {
        // Entry `first - k` is the k-th of the batch, from the back.
        let first = begin + many - 1u - done;
        let taken = min(BATCH, many - done);
        workgroupBarrier();
        if (own < 3u * taken) {
            batch[own] = records[4u * owner_of[pair_of[first - own / 3u]] + own % 3u];
        }
        workgroupBarrier();
        for (var k = 0u; k < taken; k += 1u) {
            let one = batch[3u * k];
            let two = batch[3u * k + 1u];
            let three = batch[3u * k + 2u];
            let d = pixel - one.xy;
            let power = exponent(one, two, d);
            var v = 0.0;
            var weight = 0.0;
            if (power >= -LOG2_255 && last >= f32(first - k - begin)) {
                let alpha = min(exp2(power), MAX_ALPHA);
                left /= 1.0 - alpha;
                weight = alpha * left;
                let here = push.x * two.z + push.y * two.w + push.z * three.x + push.w * three.y;
                let change = here - behind;
                behind += alpha * change;
                let below = alpha + SOFT;
                v = weight * change + load_push * alpha * SOFT / (below * below);
                v = select(v, 0.0, power >= LOG2_MAX_ALPHA);
            }
            shared_values[256u * k + own] = v;
            shared_values[2048u + 256u * k + own] = weight;
        }
        workgroupBarrier();
        var sums = array<f32, 12>();
        if (g < taken) {
            let one = batch[3u * g];
            let two = batch[3u * g + 1u];
            for (var k = 0u; k < 8u; k += 1u) {
                let q = lane + 32u * k;
                let v = shared_values[256u * g + q];
                let weight = shared_values[2048u + 256u * g + q];
                let d = corner + vec2<f32>(f32(q % TILE), f32(q / TILE)) - one.xy;
                sums[0] += v;
                sums[1] += v * d.x;
                sums[2] += v * d.y;
                sums[3] += v * d.x * d.x;
                sums[4] += v * d.x * d.y;
                sums[5] += v * d.y * d.y;
                let pushed = pushes[q];
                sums[6] += weight * pushed.x;
                sums[7] += weight * pushed.y;
                sums[8] += weight * pushed.z;
                sums[9] += weight * pushed.w;
                if (view.with_mean_gradients != 0u) {
                    let pull = v - pull_of_load(one, two, d, load_pushes[q], weight);
                    sums[10] += abs(pull * (2.0 * one.z * d.x + one.w * d.y));
                    sums[11] += abs(pull * (one.w * d.x + 2.0 * two.x * d.y));
                }
            }
        }
        workgroupBarrier();
        if (g < taken) {
            for (var m = 0u; m < MOMENTS; m += 1u) {
                shared_values[(m * BATCH + g) * 33u + lane] = sums[m];
            }
        }
        workgroupBarrier();
        if (own < MOMENTS * BATCH && own % BATCH < taken) {
            var sum = 0.0;
            for (var k = 0u; k < 32u; k += 1u) {
                sum += shared_values[own * 33u + k];
            }
            moments[pair_of[first - own % BATCH] * MOMENTS + own / BATCH] = sum;
        }
    }
}
