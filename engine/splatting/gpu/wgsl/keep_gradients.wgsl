// The gradients are the result.

@group(0) @binding(6) var<storage, read_write> d_values: array<f32>;  // columns as in values
@group(0) @binding(7) var<storage, read_write> d_screen: array<vec4<f32>>;  // offsets, and Σ|·| of them over pixels

fn skipped() -> bool {
    return false;
}

fn store_nothing(i: u32) {
    d_screen[i] = vec4<f32>(0.0);
}

fn begin_gradients(i: u32) {
}

fn store_screen(i: u32, offset: vec2<f32>, pulls: vec2<f32>) {
    d_screen[i] = vec4<f32>(offset, pulls);
}

fn store_gradient(i: u32, column: u32, gradient: f32, rate: f32) {
    d_values[column * view.count + i] = gradient;
}
