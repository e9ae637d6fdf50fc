// Gaussians → ellipses (see kernels/project.py for the equations).

const LOW_PASS: f32 = 0.3;
const THINNEST: f32 = 1e-6;
const MARGIN: f32 = 0.3;
const FLOOR: f32 = 1e-12;
const HUGE: f32 = 1e12;
const LARGEST_LOG_SCALE: f32 = 30.0;
const WIDEST: f32 = 1e12;

fn value(column: u32, i: u32) -> f32 {
    return values[column * view.count + i];
}

fn mean_of(i: u32) -> vec3<f32> {
    return vec3<f32>(value(MEAN, i), value(MEAN + 1u, i), value(MEAN + 2u, i));
}

fn log_scales_of(i: u32) -> vec3<f32> {
    return vec3<f32>(value(LOG_SCALE, i), value(LOG_SCALE + 1u, i), value(LOG_SCALE + 2u, i));
}

// w, x, y, z as stored.
fn quat_of(i: u32) -> vec4<f32> {
    return vec4<f32>(value(QUAT, i), value(QUAT + 1u, i), value(QUAT + 2u, i), value(QUAT + 3u, i));
}

fn center() -> vec3<f32> {
    return vec3<f32>(view.camera[18], view.camera[19], view.camera[20]);
}

fn to_camera(p: vec3<f32>) -> vec3<f32> {
    return vec3<f32>(
        view.camera[0] * p.x + view.camera[1] * p.y + view.camera[2] * p.z,
        view.camera[3] * p.x + view.camera[4] * p.y + view.camera[5] * p.z,
        view.camera[6] * p.x + view.camera[7] * p.y + view.camera[8] * p.z,
    );
}

fn from_camera(p: vec3<f32>) -> vec3<f32> {
    return vec3<f32>(
        view.camera[0] * p.x + view.camera[3] * p.y + view.camera[6] * p.z,
        view.camera[1] * p.x + view.camera[4] * p.y + view.camera[7] * p.z,
        view.camera[2] * p.x + view.camera[5] * p.y + view.camera[8] * p.z,
    );
}

// Unit quaternion (w, x, y, z), and one over the length of the given one.
fn unit_quat(q: vec4<f32>, scale: ptr<function, f32>) -> vec4<f32> {
    *scale = 1.0 / sqrt(max(dot(q, q), 1e-24));
    return q * *scale;
}

// Column k of the rotation of a unit quaternion (w, x, y, z).
fn axis_of(q: vec4<f32>, k: u32) -> vec3<f32> {
    let w = q.x;
    let x = q.y;
    let y = q.z;
    let z = q.w;
    if (k == 0u) {
        return vec3<f32>(1.0 - 2.0 * (y * y + z * z), 2.0 * (x * y + w * z), 2.0 * (x * z - w * y));
    }
    if (k == 1u) {
        return vec3<f32>(2.0 * (x * y - w * z), 1.0 - 2.0 * (x * x + z * z), 2.0 * (y * z + w * x));
    }
    return vec3<f32>(2.0 * (x * z + w * y), 2.0 * (y * z - w * x), 1.0 - 2.0 * (x * x + y * y));
}

// Range of x/z (x, y) and of y/z (z, w) in the derivative of the projection.
fn limits() -> vec4<f32> {
    let focal = vec2<f32>(view.camera[12], view.camera[13]);
    let principal = vec2<f32>(view.camera[14], view.camera[15]);
    let size = vec2<f32>(view.camera[16], view.camera[17]);
    let beyond = MARGIN * 0.5 * size / focal;
    let low = -principal / focal - beyond;
    let high = (size - principal) / focal + beyond;
    return vec4<f32>(low.x, high.x, low.y, high.y);
}

// j00, j02, j11, j12: the derivative of the projection at a position in the camera.
fn derivative(p: vec3<f32>) -> vec4<f32> {
    let inverse = 1.0 / p.z;
    let range = limits();
    let u = clamp(p.x * inverse, range.x, range.y);
    let v = clamp(p.y * inverse, range.z, range.w);
    let fx = view.camera[12] * inverse;
    let fy = view.camera[13] * inverse;
    return vec4<f32>(fx, -fx * u, fy, -fy * v);
}

// Axis k of a Gaussian, as long as its standard deviation, on the image.
fn on_image(axis: vec3<f32>, j: vec4<f32>) -> vec2<f32> {
    let v = to_camera(axis);
    return vec2<f32>(j.x * v.x + j.y * v.z, j.z * v.y + j.w * v.z);
}

// xx, xy, yy and determinant of an ellipse's covariance, before it is widened.
fn covariance(q: vec4<f32>, log_scales: vec3<f32>, j: vec4<f32>) -> vec4<f32> {
    let a = on_image(axis_of(q, 0u) * exp(log_scales.x), j);
    let b = on_image(axis_of(q, 1u) * exp(log_scales.y), j);
    let c = on_image(axis_of(q, 2u) * exp(log_scales.z), j);
    let ab = a.x * b.y - b.x * a.y;
    let bc = b.x * c.y - c.x * b.y;
    let ac = a.x * c.y - c.x * a.y;
    return vec4<f32>(
        a.x * a.x + b.x * b.x + c.x * c.x,
        a.x * a.y + b.x * b.y + c.x * c.y,
        a.y * a.y + b.y * b.y + c.y * c.y,
        ab * ab + bc * bc + ac * ac,
    );
}
