// Real spherical harmonics, as kernels/harmonics.py.

const C0: f32 = 0.28209479177387814;
const C1: f32 = 0.4886025119029199;
const C2A: f32 = 1.0925484305920792;
const C2B: f32 = 0.31539156525252005;
const C2C: f32 = 0.5462742152960396;
const C3A: f32 = 0.5900435899266435;
const C3B: f32 = 2.890611442640554;
const C3C: f32 = 0.4570457994644658;
const C3D: f32 = 0.3731763325901154;
const C3E: f32 = 1.445305721320277;

fn basis(degree: u32, d: vec3<f32>) -> array<f32, 16> {
    var out = array<f32, 16>();
    let x = d.x;
    let y = d.y;
    let z = d.z;
    out[0] = C0;
    if (degree >= 1u) {
        out[1] = -C1 * y;
        out[2] = C1 * z;
        out[3] = -C1 * x;
    }
    if (degree >= 2u) {
        out[4] = C2A * x * y;
        out[5] = -C2A * y * z;
        out[6] = C2B * (2.0 * z * z - x * x - y * y);
        out[7] = -C2A * x * z;
        out[8] = C2C * (x * x - y * y);
    }
    if (degree >= 3u) {
        out[9] = -C3A * y * (3.0 * x * x - y * y);
        out[10] = C3B * x * y * z;
        out[11] = -C3C * y * (4.0 * z * z - x * x - y * y);
        out[12] = C3D * z * (2.0 * z * z - 3.0 * x * x - 3.0 * y * y);
        out[13] = -C3C * x * (4.0 * z * z - x * x - y * y);
        out[14] = C3E * z * (x * x - y * y);
        out[15] = -C3A * x * (x * x - 3.0 * y * y);
    }
    return out;
}

// Gradient with respect to the direction of Σ g[k] · basis[k].
fn direction_backward(degree: u32, d: vec3<f32>, g: ptr<function, array<f32, 16>>) -> vec3<f32> {
    let x = d.x;
    let y = d.y;
    let z = d.z;
    var out = vec3<f32>(0.0);
    if (degree >= 1u) {
        out += vec3<f32>(-C1 * (*g)[3], -C1 * (*g)[1], C1 * (*g)[2]);
    }
    if (degree >= 2u) {
        out.x += C2A * y * (*g)[4] - 2.0 * C2B * x * (*g)[6] - C2A * z * (*g)[7] + 2.0 * C2C * x * (*g)[8];
        out.y += C2A * x * (*g)[4] - C2A * z * (*g)[5] - 2.0 * C2B * y * (*g)[6] - 2.0 * C2C * y * (*g)[8];
        out.z += -C2A * y * (*g)[5] + 4.0 * C2B * z * (*g)[6] - C2A * x * (*g)[7];
    }
    if (degree >= 3u) {
        let xx = x * x;
        let yy = y * y;
        let zz = z * z;
        out.x += -C3A * 6.0 * x * y * (*g)[9] + C3B * y * z * (*g)[10] + C3C * 2.0 * x * y * (*g)[11];
        out.x += -C3D * 6.0 * x * z * (*g)[12] - C3C * (4.0 * zz - 3.0 * xx - yy) * (*g)[13];
        out.x += C3E * 2.0 * x * z * (*g)[14] - C3A * 3.0 * (xx - yy) * (*g)[15];
        out.y += -C3A * 3.0 * (xx - yy) * (*g)[9] + C3B * x * z * (*g)[10] - C3C * (4.0 * zz - xx - 3.0 * yy) * (*g)[11];
        out.y += -C3D * 6.0 * y * z * (*g)[12] + C3C * 2.0 * x * y * (*g)[13];
        out.y += -C3E * 2.0 * y * z * (*g)[14] + C3A * 6.0 * x * y * (*g)[15];
        out.z += C3B * x * y * (*g)[10] - C3C * 8.0 * y * z * (*g)[11];
        out.z += C3D * (6.0 * zz - 3.0 * xx - 3.0 * yy) * (*g)[12] - C3C * 8.0 * x * z * (*g)[13];
        out.z += C3E * (xx - yy) * (*g)[14];
    }
    return out;
}
