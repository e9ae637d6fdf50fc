// What all kernels of a view share: its settings, and the layout of the buffers.
//
// Parameters lie column by column: value c of Gaussian i is at c * count + i, so that neighbouring invocations read
// neighbouring numbers. Columns: 3 mean, 3 log scale, 4 quaternion, 1 opacity logit, then the harmonics (3 a basis
// function).

struct View {
    camera: array<f32, 21>,  // as render.camera_values
    pair_alpha: f32,
    background: array<f32, 3>,
    count: u32,
    degree: u32,
    antialiased: u32,
    literal: u32,
    width: u32,
    height: u32,
    columns: u32,
    rows: u32,
    capacity: u32,  // pairs that the buffers can hold
    with_depth: u32,
    with_mean_gradients: u32,
    l1_weight: f32,
    ssim_weight: f32,
    rates: array<f32, 6>,  // means, log scales, quaternions, opacity logits, base colour, other harmonics
    opacity_weight: f32,  // of the regularisers, divided as train.regularise does
    scale_weight: f32,
    flatness_weight: f32,
    middle: array<f32, 3>,
    extent: f32,
    slot: u32,  // where the loss of this step goes
    with_pose: u32,
    load_share: f32,  // weight of the unevenness of loads beside the photometric loss, 0 for none
    exposure: array<f32, 12>,  // 3 × 4
    channels: u32,
}

// Counts that the card computes and that later kernels of the same view need.
struct Plan {
    gaussians: u32,
    pairs: u32,
    needed: u32,  // pairs of the view, also if they are more than the capacity
    full: u32,  // 1 once a view needed more than the capacity; nothing is drawn or updated from then on
    near: f32,
    taken: u32,  // steps of training since the host last looked
    blocks: vec3<u32>,  // workgroups that sort the pairs
    entries: vec3<u32>,  // workgroups with one invocation a pair
}

const MEAN: u32 = 0u;
const LOG_SCALE: u32 = 3u;
const QUAT: u32 = 6u;
const LOGIT: u32 = 10u;
const SH: u32 = 11u;

const TILE: u32 = 16u;
const SLACK: f32 = 1e-3;
const LOG2_E: f32 = 1.4426950408889634;
const LOG2_255: f32 = 7.994353436858858;
const LOG2_MAX_ALPHA: f32 = -0.014499569695115089;
const MAX_ALPHA: f32 = 0.99;
const STOP: f32 = 1e-4;
const SOFT: f32 = 0.0625;

// The exponent of two that is a Gaussian's α at a distance d from its projected mean. one, two: of its record.
fn exponent(one: vec4<f32>, two: vec4<f32>, d: vec2<f32>) -> f32 {
    return two.y - (one.z * d.x * d.x + one.w * d.x * d.y + two.x * d.y * d.y);
}
