// Further channels of a view, and the front surface: one workgroup a tile, one invocation a pixel.

@group(0) @binding(0) var<storage, read> view: View;
@group(0) @binding(1) var<storage, read> records: array<vec4<f32>>;
@group(0) @binding(2) var<storage, read> tile_starts: array<u32>;
@group(0) @binding(3) var<storage, read> pair_of: array<u32>;
@group(0) @binding(4) var<storage, read> owner_of: array<u32>;
@group(0) @binding(5) var<storage, read> planes: array<f32>;
@group(0) @binding(6) var<storage, read> features: array<f32>;  // (N, channels)
@group(0) @binding(7) var<storage, read_write> blended: array<f32>;  // (channels, H, W)
@group(0) @binding(8) var<storage, read_write> depths: array<f32>;  // (H, W)

const TOGETHER: u32 = 8u;  // channels that an invocation blends

fn alpha_of(at: u32, pixel: vec2<f32>) -> f32 {
    let one = records[at];
    let two = records[at + 1u];
    let d = pixel - one.xy;
    let power = exponent(one, two, d);
    return select(min(exp2(power), MAX_ALPHA), 0.0, power < -LOG2_255);
}

@compute @workgroup_size(16, 16)
fn blend_features(@builtin(local_invocation_index) own: u32, @builtin(workgroup_id) group: vec3<u32>) {
    let x = group.x * TILE + own % TILE;
    let y = group.y * TILE + own / TILE;
    if (x >= view.width || y >= view.height) {
        return;
    }
    let pixel = vec2<f32>(f32(x) + 0.5, f32(y) + 0.5);
    let tile = group.y * view.columns + group.x;
    let begin = tile_starts[tile];
    let size = view.width * view.height;
    let last = planes[5u * size + y * view.width + x];
    let first = group.z * TOGETHER;
    var sums = array<f32, 8>();
    var left = 1.0;
    for (var entry = begin; entry < tile_starts[tile + 1u] && f32(entry - begin) <= last; entry += 1u) {
        let owner = owner_of[pair_of[entry]];
        let weight = alpha_of(4u * owner, pixel) * left;
        left -= weight;
        if (weight > 0.0) {
            for (var k = 0u; k < TOGETHER && first + k < view.channels; k += 1u) {
                sums[k] += weight * features[owner * view.channels + first + k];
            }
        }
    }
    for (var k = 0u; k < TOGETHER && first + k < view.channels; k += 1u) {
        blended[(first + k) * size + y * view.width + x] = sums[k];
    }
}

// The depth of the Gaussian at which half of the light has been stopped (kernels/surface.py).
@compute @workgroup_size(16, 16)
fn measure_surface(@builtin(local_invocation_index) own: u32, @builtin(workgroup_id) group: vec3<u32>) {
    let x = group.x * TILE + own % TILE;
    let y = group.y * TILE + own / TILE;
    if (x >= view.width || y >= view.height) {
        return;
    }
    let pixel = vec2<f32>(f32(x) + 0.5, f32(y) + 0.5);
    let tile = group.y * view.columns + group.x;
    var depth = NOTHING;
    var left = 1.0;
    for (var entry = tile_starts[tile]; entry < tile_starts[tile + 1u]; entry += 1u) {
        let at = 4u * owner_of[pair_of[entry]];
        left -= left * alpha_of(at, pixel);
        if (left < 0.5) {
            depth = records[at + 2u].y;
            break;
        }
    }
    depths[y * view.width + x] = depth;
}
