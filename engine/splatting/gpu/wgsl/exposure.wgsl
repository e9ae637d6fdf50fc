// An affine change of the image's colours, and its gradients (kernels/exposure.py).

@group(0) @binding(0) var<storage, read> view: View;
@group(0) @binding(1) var<storage, read_write> plan: Plan;
@group(0) @binding(2) var<storage, read> planes: array<f32>;  // of which three are colours
@group(0) @binding(3) var<storage, read_write> exposed: array<f32>;  // (3, H, W)
@group(0) @binding(4) var<storage, read_write> gradients: array<f32>;  // of exposed; then of the planes' colours
@group(0) @binding(5) var<storage, read_write> color_partial: array<f32>;  // (12, tiles) sums over a tile
@group(0) @binding(6) var<storage, read_write> color_sums: array<f32>;  // (slots, 12) gradients of the matrices

@compute @workgroup_size(256)
fn expose(@builtin(global_invocation_id) id: vec3<u32>, @builtin(num_workgroups) groups: vec3<u32>) {
    let size = view.width * view.height;
    let at = id.x + id.y * groups.x * 256u;
    if (at >= size) {
        return;
    }
    let color = vec4<f32>(planes[at], planes[size + at], planes[2u * size + at], 1.0);
    for (var c = 0u; c < 3u; c += 1u) {
        let row = vec4<f32>(view.exposure[4u * c], view.exposure[4u * c + 1u], view.exposure[4u * c + 2u],
            view.exposure[4u * c + 3u]);
        exposed[c * size + at] = dot(row, color);
    }
}

@compute @workgroup_size(16, 16)
fn exposure_backward(@builtin(local_invocation_index) own: u32, @builtin(workgroup_id) group: vec3<u32>) {
    let x = group.x * TILE + own % TILE;
    let y = group.y * TILE + own / TILE;
    let size = view.width * view.height;
    let at = y * view.width + x;
    var color = vec4<f32>(0.0);
    var push = vec3<f32>(0.0);
    if (x < view.width && y < view.height) {
        color = vec4<f32>(planes[at], planes[size + at], planes[2u * size + at], 1.0);
        push = vec3<f32>(gradients[at], gradients[size + at], gradients[2u * size + at]);
        for (var k = 0u; k < 3u; k += 1u) {
            gradients[k * size + at] = view.exposure[k] * push.x + view.exposure[4u + k] * push.y
                + view.exposure[8u + k] * push.z;
        }
    }
    for (var m = 0u; m < 12u; m += 1u) {
        let sum = total(own, push[m / 4u] * color[m % 4u]);
        if (own == 0u) {
            color_partial[m * view.columns * view.rows + group.y * view.columns + group.x] = sum;
        }
    }
}

// One workgroup a number of the matrix.
@compute @workgroup_size(256)
fn exposure_total(@builtin(local_invocation_index) own: u32, @builtin(workgroup_id) group: vec3<u32>) {
    let tiles = view.columns * view.rows;
    var sum = 0.0;
    for (var k = own; k < tiles; k += 256u) {
        sum += color_partial[group.x * tiles + k];
    }
    let whole = total(own, sum);
    if (own == 0u && plan.full == 0u) {
        color_sums[view.slot * 12u + group.x] = whole;
    }
}
