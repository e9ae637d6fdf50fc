// One workgroup a tile, one invocation a pixel: blends the tile's list front to back (kernels/tile.py has the equation).

@group(0) @binding(0) var<storage, read> view: View;
@group(0) @binding(1) var<storage, read> records: array<vec4<f32>>;
@group(0) @binding(2) var<storage, read> tile_starts: array<u32>;
@group(0) @binding(3) var<storage, read> pair_of: array<u32>;  // of each entry of the lists
@group(0) @binding(4) var<storage, read> owner_of: array<u32>;  // of each pair
@group(0) @binding(5) var<storage, read_write> planes: array<f32>;  // (6, H, W) as `kernels.blend` writes them

const BATCH: u32 = 256u;

var<workgroup> batch: array<vec4<f32>, 768>;
var<workgroup> finished: atomic<u32>;
var<workgroup> all_finished: u32;

@compute @workgroup_size(16, 16)
fn blend(@builtin(local_invocation_index) own: u32, @builtin(workgroup_id) group: vec3<u32>) {
    let x = group.x * TILE + own % TILE;
    let y = group.y * TILE + own / TILE;
    let pixel = vec2<f32>(f32(x) + 0.5, f32(y) + 0.5);
    let inside = x < view.width && y < view.height;
    let tile = group.y * view.columns + group.x;
    let begin = tile_starts[tile];
    let end = tile_starts[tile + 1u];
    var color = vec3<f32>(0.0);
    var depth = 0.0;
    var left = 1.0;
    var last = 0.0;
    var alive = inside;
    if (own == 0u) {
        atomicStore(&finished, 0u);
        all_finished = 0u;
    }
    workgroupBarrier();
    if (!inside) {
        atomicAdd(&finished, 1u);
    }
    for (var first = begin; first < end; first += BATCH) {
        workgroupBarrier();
        if (own == 0u && atomicLoad(&finished) == 256u) {
            all_finished = 1u;
        }
        if (workgroupUniformLoad(&all_finished) != 0u) {
            break;
        }
        if (first + own < end) {
            let at = 4u * owner_of[pair_of[first + own]];
            batch[3u * own] = records[at];
            batch[3u * own + 1u] = records[at + 1u];
            batch[3u * own + 2u] = records[at + 2u];
        }
        workgroupBarrier();
        let many = min(BATCH, end - first);
        for (var k = 0u; alive && k < many; k += 1u) {
            let one = batch[3u * k];
            let two = batch[3u * k + 1u];
            let d = pixel - one.xy;
            let power = exponent(one, two, d);
            if (power < -LOG2_255) {
                continue;
            }
            let three = batch[3u * k + 2u];
            let weight = min(exp2(power), MAX_ALPHA) * left;
            color += weight * vec3<f32>(two.zw, three.x);
            depth += weight * three.y;
            left -= weight;
            last = f32(first + k - begin);
            if (left < STOP) {
                alive = false;
                atomicAdd(&finished, 1u);
            }
        }
    }
    if (inside) {
        let size = view.width * view.height;
        let at = y * view.width + x;
        planes[at] = color.x;
        planes[size + at] = color.y;
        planes[2u * size + at] = color.z;
        planes[3u * size + at] = depth;
        planes[4u * size + at] = left;
        planes[5u * size + at] = last;
    }
}
