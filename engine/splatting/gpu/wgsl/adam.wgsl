// Adam takes its step for every Gaussian that the view drew (kernels/adam.py), and densification's statistics count it
// (kernels/densify.py).

@group(0) @binding(6) var<storage, read_write> first: array<f32>;
@group(0) @binding(7) var<storage, read_write> second: array<f32>;
@group(0) @binding(8) var<storage, read_write> updates: array<u32>;
@group(0) @binding(9) var<storage, read> corrections: array<vec2<f32>>;
@group(0) @binding(10) var<storage, read_write> pulls: array<vec2<f32>>;  // sums and counts of GradientStats
@group(0) @binding(11) var<storage, read> plan: Plan;

const BETA_1: f32 = 0.9;
const BETA_2: f32 = 0.999;
const EPSILON: f32 = 1e-15;

var<private> correction: vec2<f32>;

fn skipped() -> bool {
    return plan.full != 0u;
}

fn store_nothing(i: u32) {
}

fn begin_gradients(i: u32) {
    updates[i] += 1u;
    correction = corrections[min(updates[i], arrayLength(&corrections) - 1u)];
}

fn store_screen(i: u32, offset: vec2<f32>, pull: vec2<f32>) {
    if (view.with_mean_gradients != 0u) {
        let halves = pull * 0.5 * vec2<f32>(f32(view.width), f32(view.height));
        pulls[i] += vec2<f32>(sqrt(dot(halves, halves)), 1.0);
    }
}

fn store_gradient(i: u32, column: u32, gradient: f32, rate: f32) {
    let at = column * view.count + i;
    let m = BETA_1 * first[at] + (1.0 - BETA_1) * gradient;
    let v = BETA_2 * second[at] + (1.0 - BETA_2) * gradient * gradient;
    first[at] = m;
    second[at] = v;
    values[at] -= rate * correction.x * m / (sqrt(v) * correction.y + EPSILON);
}
