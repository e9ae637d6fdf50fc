// The smooth number of Gaussians that a pixel blends (kernels/load.py), and its mean and spread over the image.

@group(0) @binding(0) var<storage, read> view: View;
@group(0) @binding(1) var<storage, read> records: array<vec4<f32>>;
@group(0) @binding(2) var<storage, read> tile_starts: array<u32>;
@group(0) @binding(3) var<storage, read> pair_of: array<u32>;
@group(0) @binding(4) var<storage, read> owner_of: array<u32>;
@group(0) @binding(5) var<storage, read> planes: array<f32>;
@group(0) @binding(6) var<storage, read_write> loads: array<f32>;  // (H, W)
@group(0) @binding(7) var<storage, read_write> load_partial: array<f32>;  // (tiles,)
@group(0) @binding(8) var<storage, read_write> load_total: array<f32>;  // mean, spread

@compute @workgroup_size(16, 16)
fn measure_loads(@builtin(local_invocation_index) own: u32, @builtin(workgroup_id) group: vec3<u32>) {
    let x = group.x * TILE + own % TILE;
    let y = group.y * TILE + own / TILE;
    let pixel = vec2<f32>(f32(x) + 0.5, f32(y) + 0.5);
    let inside = x < view.width && y < view.height;
    let tile = group.y * view.columns + group.x;
    let begin = tile_starts[tile];
    let end = tile_starts[tile + 1u];
    var load = 0.0;
    if (inside) {
        let size = view.width * view.height;
        let last = planes[5u * size + y * view.width + x];
        for (var entry = begin; entry < end && f32(entry - begin) <= last; entry += 1u) {
            let at = 4u * owner_of[pair_of[entry]];
            let one = records[at];
            let two = records[at + 1u];
            let d = pixel - one.xy;
            let power = exponent(one, two, d);
            if (power >= -LOG2_255) {
                let alpha = min(exp2(power), MAX_ALPHA);
                load += alpha / (alpha + SOFT);
            }
        }
        loads[y * view.width + x] = load;
    }
    let sum = total(own, load);
    if (own == 0u) {
        load_partial[tile] = sum;
    }
}

// One workgroup: first the mean, then the spread around it.
@compute @workgroup_size(256)
fn load_statistics(@builtin(local_invocation_index) own: u32) {
    let size = view.width * view.height;
    var sum = 0.0;
    for (var k = own; k < view.columns * view.rows; k += 256u) {
        sum += load_partial[k];
    }
    let mean = total(own, sum) / f32(size);
    var squares = 0.0;
    for (var k = own; k < size; k += 256u) {
        squares += (loads[k] - mean) * (loads[k] - mean);
    }
    let square = total(own, squares) / f32(size);
    if (own == 0u) {
        load_total[0] = mean;
        load_total[1] = sqrt(square);
    }
}
