// L1 and SSIM of the image against a photo, value and gradient (kernels/loss.py has the equations).
//
// One workgroup a tile of 16 × 16 pixels and colour channel; the windows' reach of 5 pixels is read around it.

@group(0) @binding(0) var<storage, read> view: View;
@group(0) @binding(1) var<storage, read> image: array<f32>;  // (3 or more, H, W)
@group(0) @binding(2) var<storage, read> photo: array<u32>;  // (H, W) red, green, blue, and 255 where it may be used
@group(0) @binding(3) var<storage, read_write> slopes: array<f32>;  // (3 channels, 3, H, W)
@group(0) @binding(4) var<storage, read_write> partial: array<vec2<f32>>;  // (3, tiles) sums of L1 and of SSIM
@group(0) @binding(5) var<storage, read_write> gradients: array<f32>;  // (5, H, W), of which three are written
@group(0) @binding(6) var<storage, read_write> losses: array<vec2<f32>>;  // (slots,) sums of L1 and of SSIM
@group(0) @binding(7) var<storage, read_write> plan: Plan;

const RADIUS: u32 = 5u;
const WIDE: u32 = 26u;  // TILE + 2 · RADIUS
const PLANE: u32 = 416u;  // WIDE · TILE
const C1: f32 = 0.0001;
const C2: f32 = 0.0009;
const TINY: f32 = 1e-12;

var<workgroup> wide: array<f32, 2028>;  // up to three planes of WIDE × WIDE
var<workgroup> narrow: array<f32, 2080>;  // up to five planes of WIDE rows × TILE
var<workgroup> sums: array<vec2<f32>, 256>;

// The window's weights by distance from its middle.
fn window(away: u32) -> f32 {
    switch (away) {
        case 0u: { return W0; }
        case 1u: { return W1; }
        case 2u: { return W2; }
        case 3u: { return W3; }
        case 4u: { return W4; }
        default: { return W5; }
    }
}

fn weight_at(k: u32) -> f32 {  // of the k-th of the window's eleven pixels
    return window(u32(abs(i32(k) - 5)));
}

// x: the image where the photo may be used, else the photo; y: the photo; z: whether it may be used. 0 outside.
fn pixel_at(x: i32, y: i32, channel: u32) -> vec3<f32> {
    if (x < 0 || y < 0 || x >= i32(view.width) || y >= i32(view.height)) {
        return vec3<f32>(0.0);
    }
    let at = u32(y) * view.width + u32(x);
    let packed = photo[at];
    let truth = f32((packed >> (8u * channel)) & 255u) * (1.0 / 255.0);
    if ((packed >> 24u) == 0u) {
        return vec3<f32>(truth, truth, 0.0);
    }
    return vec3<f32>(image[channel * view.width * view.height + at], truth, 1.0);
}

@compute @workgroup_size(16, 16)
fn ssim(@builtin(local_invocation_index) own: u32, @builtin(workgroup_id) group: vec3<u32>) {
    let channel = group.z;
    let left = i32(group.x * TILE) - i32(RADIUS);
    let top = i32(group.y * TILE) - i32(RADIUS);
    for (var k = own; k < WIDE * WIDE; k += 256u) {
        let seen = pixel_at(left + i32(k % WIDE), top + i32(k / WIDE), channel);
        wide[k] = seen.x;
        wide[WIDE * WIDE + k] = seen.y;
    }
    workgroupBarrier();
    for (var k = own; k < WIDE * TILE; k += 256u) {
        let at = (k / TILE) * WIDE + k % TILE;
        var own_sums = vec3<f32>(0.0);  // E of x, x², xy
        var photo_sums = vec2<f32>(0.0);  // E of y, y²
        for (var w = 0u; w < 11u; w += 1u) {
            let x = wide[at + w];
            let y = wide[WIDE * WIDE + at + w];
            own_sums += weight_at(w) * vec3<f32>(x, x * x, x * y);
            photo_sums += weight_at(w) * vec2<f32>(y, y * y);
        }
        narrow[k] = own_sums.x;
        narrow[PLANE + k] = own_sums.y;
        narrow[2u * PLANE + k] = own_sums.z;
        narrow[3u * PLANE + k] = photo_sums.x;
        narrow[4u * PLANE + k] = photo_sums.y;
    }
    workgroupBarrier();
    let x = group.x * TILE + own % TILE;
    let y = group.y * TILE + own / TILE;
    var both = vec2<f32>(0.0);
    if (x < view.width && y < view.height) {
        var own_sums = vec3<f32>(0.0);
        var photo_sums = vec2<f32>(0.0);
        for (var w = 0u; w < 11u; w += 1u) {
            let at = own + w * TILE;
            own_sums += weight_at(w) * vec3<f32>(narrow[at], narrow[PLANE + at], narrow[2u * PLANE + at]);
            photo_sums += weight_at(w) * vec2<f32>(narrow[3u * PLANE + at], narrow[4u * PLANE + at]);
        }
        let seen = pixel_at(i32(x), i32(y), channel);
        let mx = own_sums.x;
        let my = photo_sums.x;
        let vx = own_sums.y - mx * mx;
        let vy = photo_sums.y - my * my;
        let covariance = own_sums.z - mx * my;
        let a1 = mx * my * 2.0 + C1;
        let a2 = covariance * 2.0 + C2;
        let b1 = mx * mx + my * my + C1;
        let b2 = vx + vy + C2;
        let inverse = seen.z / (b1 * b2);
        let s = a1 * a2 * inverse;
        let size = view.width * view.height;
        let at = 3u * channel * size + y * view.width + x;
        slopes[at] = (my * (a2 - a1) * inverse - s * mx * (1.0 / b1 - 1.0 / b2)) * 2.0;
        slopes[at + size] = -s / b2;
        slopes[at + 2u * size] = a1 * inverse * 2.0;
        both = vec2<f32>(abs(seen.x - seen.y), s);
    }
    sums[own] = both;
    workgroupBarrier();
    for (var half = 128u; half > 0u; half /= 2u) {
        if (own < half) {
            sums[own] += sums[own + half];
        }
        workgroupBarrier();
    }
    if (own == 0u) {
        partial[(channel * view.rows + group.y) * view.columns + group.x] = sums[0];
    }
}

@compute @workgroup_size(16, 16)
fn ssim_backward(@builtin(local_invocation_index) own: u32, @builtin(workgroup_id) group: vec3<u32>) {
    let channel = group.z;
    let size = view.width * view.height;
    let left = i32(group.x * TILE) - i32(RADIUS);
    let top = i32(group.y * TILE) - i32(RADIUS);
    for (var k = own; k < WIDE * WIDE; k += 256u) {
        let x = left + i32(k % WIDE);
        let y = top + i32(k / WIDE);
        let inside = x >= 0 && y >= 0 && x < i32(view.width) && y < i32(view.height);
        for (var plane = 0u; plane < 3u; plane += 1u) {
            var slope = 0.0;
            if (inside) {
                slope = slopes[(3u * channel + plane) * size + u32(y) * view.width + u32(x)];
            }
            wide[plane * WIDE * WIDE + k] = slope;
        }
    }
    workgroupBarrier();
    for (var k = own; k < WIDE * TILE; k += 256u) {
        let at = (k / TILE) * WIDE + k % TILE;
        for (var plane = 0u; plane < 3u; plane += 1u) {
            var sum = 0.0;
            for (var w = 0u; w < 11u; w += 1u) {
                sum += weight_at(w) * wide[plane * WIDE * WIDE + at + w];
            }
            narrow[plane * PLANE + k] = sum;
        }
    }
    workgroupBarrier();
    let x = group.x * TILE + own % TILE;
    let y = group.y * TILE + own / TILE;
    if (x >= view.width || y >= view.height) {
        return;
    }
    var fallen = vec3<f32>(0.0);
    for (var w = 0u; w < 11u; w += 1u) {
        let at = own + w * TILE;
        fallen += weight_at(w) * vec3<f32>(narrow[at], narrow[PLANE + at], narrow[2u * PLANE + at]);
    }
    let seen = pixel_at(i32(x), i32(y), channel);
    let d = seen.x - seen.y;
    var sign = 0.0;
    if (d >= TINY) {
        sign = 1.0;
    } else if (-d >= TINY) {
        sign = -1.0;
    }
    let slope = fallen.x + seen.x * fallen.y * 2.0 + seen.y * fallen.z;
    gradients[channel * size + y * view.width + x] = (sign * view.l1_weight - slope * view.ssim_weight) * seen.z;
}

// One workgroup: the sums over all tiles and channels.
@compute @workgroup_size(256)
fn loss_total(@builtin(local_invocation_index) own: u32) {
    var both = vec2<f32>(0.0);
    for (var k = own; k < 3u * view.rows * view.columns; k += 256u) {
        both += partial[k];
    }
    sums[own] = both;
    workgroupBarrier();
    for (var half = 128u; half > 0u; half /= 2u) {
        if (own < half) {
            sums[own] += sums[own + half];
        }
        workgroupBarrier();
    }
    if (own == 0u && plan.full == 0u) {
        losses[view.slot] = sums[0];
        plan.taken += 1u;
    }
}
