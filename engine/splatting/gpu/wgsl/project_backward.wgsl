// Gradients of the ellipses → gradients of the Gaussians (kernels/project_backward.py), one invocation a Gaussian, which
// sums its pairs in their order. What becomes of a gradient is in `store_gradient`: it is kept, or Adam takes its step.

@group(0) @binding(0) var<storage, read> view: View;
@group(0) @binding(1) var<storage, read> records: array<vec4<f32>>;
@group(0) @binding(2) var<storage, read> counts: array<u32>;
@group(0) @binding(3) var<storage, read> starts: array<u32>;
@group(0) @binding(4) var<storage, read> moments: array<f32>;
@group(0) @binding(5) var<storage, read_write> values: array<f32>;
@group(0) @binding(12) var<storage, read_write> d_pose: array<f32>;  // (15, N) if view.with_pose is not 0

const MOMENTS: u32 = 12u;

fn quat_backward(q: vec4<f32>, scale: f32, x0: vec3<f32>, x1: vec3<f32>, x2: vec3<f32>) -> vec4<f32> {
    // x0, x1, x2: gradients of the columns of the rotation.
    let w = q.x;
    let x = q.y;
    let y = q.z;
    let z = q.w;
    let d = vec4<f32>(
        2.0 * (x * (x1.z - x2.y) + y * (x2.x - x0.z) + z * (x0.y - x1.x)),
        2.0 * (y * (x1.x + x0.y) + z * (x2.x + x0.z) + w * (x1.z - x2.y) - 2.0 * x * (x1.y + x2.z)),
        2.0 * (x * (x1.x + x0.y) + z * (x2.y + x1.z) + w * (x2.x - x0.z) - 2.0 * y * (x0.x + x2.z)),
        2.0 * (x * (x2.x + x0.z) + y * (x2.y + x1.z) + w * (x0.y - x1.x) - 2.0 * z * (x0.x + x1.y)),
    );
    return (d - q * dot(q, d)) * scale;
}

// Gradient of ½ ln(det C / det(C + 0.3 I)) with respect to C (xx, xy counted once, yy).
fn fading(c: vec4<f32>) -> vec3<f32> {
    let whole = 1.0 / (c.w + LOW_PASS * (c.x + c.z) + LOW_PASS * LOW_PASS);
    if (c.w * whole <= THINNEST * THINNEST) {
        return vec3<f32>(0.0);
    }
    let narrow = 1.0 / c.w;
    return vec3<f32>(
        0.5 * (c.z * narrow - (c.z + LOW_PASS) * whole),
        -c.y * (narrow - whole),
        0.5 * (c.x * narrow - (c.x + LOW_PASS) * whole),
    );
}

@compute @workgroup_size(256)
fn project_backward(@builtin(global_invocation_id) id: vec3<u32>, @builtin(num_workgroups) groups: vec3<u32>) {
    let i = id.x + id.y * groups.x * 256u;
    if (i >= view.count) {
        return;
    }
    if (counts[i] == 0u || skipped()) {
        store_nothing(i);
        for (var k = 0u; view.with_pose != 0u && k < 15u; k += 1u) {
            d_pose[k * view.count + i] = 0.0;
        }
        return;
    }
    var g = array<f32, 12>();
    for (var pair = starts[i]; pair < starts[i] + counts[i]; pair += 1u) {
        for (var m = 0u; m < MOMENTS; m += 1u) {
            g[m] += moments[pair * MOMENTS + m];
        }
    }
    begin_gradients(i);
    let record = stored_ellipse(i);
    let a = 2.0 * record.conic.x / LOG2_E;
    let b = record.conic.y / LOG2_E;
    let c = 2.0 * record.conic.z / LOG2_E;
    let gx = a * g[1] + b * g[2];
    let gy = b * g[1] + c * g[2];
    store_screen(i, vec2<f32>(gx, gy), vec2<f32>(g[10], g[11]) / LOG2_E);

    // Of the conic K with respect to the covariance K⁻¹: -K G K (xx, xy counted once, yy).
    let t00 = a * 0.5 * g[3] + b * 0.5 * g[4];
    let t01 = a * 0.5 * g[4] + b * 0.5 * g[5];
    let t10 = b * 0.5 * g[3] + c * 0.5 * g[4];
    let t11 = b * 0.5 * g[4] + c * 0.5 * g[5];
    var conic = vec3<f32>(t00 * a + t01 * b, 2.0 * (t00 * b + t01 * c), t10 * b + t11 * c);

    let away = mean_of(i) - center();
    let p = to_camera(away);
    let z = record.depth;
    let w = 1.0 / z;
    let range = limits();
    let u = clamp(p.x * w, range.x, range.y);
    let v = clamp(p.y * w, range.z, range.w);
    let fx = view.camera[12];
    let fy = view.camera[13];
    let j = vec4<f32>(fx * w, -fx * u * w, fy * w, -fy * v * w);
    var scale = 1.0;
    let quat = unit_quat(quat_of(i), &scale);
    let log_scales = log_scales_of(i);
    if (view.antialiased != 0u) {
        conic += g[0] * fading(covariance(quat, log_scales, j));
    }
    var derivative_sums = vec4<f32>(0.0);  // gradients of j00, j02, j11, j12
    var turned = array<vec3<f32>, 3>();
    var turning = array<vec3<f32>, 3>();  // gradient of the camera's rotation, row by row
    var d_log_scales = vec3<f32>(0.0);
    for (var k = 0u; k < 3u; k += 1u) {
        let s = exp(log_scales[k]);
        let axis = axis_of(quat, k) * s;
        let seen = to_camera(axis);
        let q = vec2<f32>(j.x * seen.x + j.y * seen.z, j.z * seen.y + j.w * seen.z);
        let dq = vec2<f32>(2.0 * conic.x * q.x + conic.y * q.y, 2.0 * conic.z * q.y + conic.y * q.x);
        derivative_sums += vec4<f32>(dq.x * seen.x, dq.x * seen.z, dq.y * seen.y, dq.y * seen.z);
        let d_seen = vec3<f32>(j.x * dq.x, j.z * dq.y, j.y * dq.x + j.w * dq.y);
        let d_axis = from_camera(d_seen);
        turning[0] += d_seen.x * axis;
        turning[1] += d_seen.y * axis;
        turning[2] += d_seen.z * axis;
        d_log_scales[k] = dot(d_axis, axis);
        turned[k] = d_axis * s;
    }
    let d_quat = quat_backward(quat, scale, turned[0], turned[1], turned[2]);

    var d_p = vec3<f32>(gx * fx * w, gy * fy * w, g[9] - (gx * fx * p.x + gy * fy * p.y) * w * w);
    d_p.z += -(derivative_sums.x * fx + derivative_sums.z * fy) * w * w;
    d_p.z += (derivative_sums.y * fx * u + derivative_sums.w * fy * v) * w * w;
    if (range.x < p.x * w && p.x * w < range.y) {
        d_p.x -= derivative_sums.y * fx * w * w;
        d_p.z += derivative_sums.y * fx * w * w * u;
    }
    if (range.z < p.y * w && p.y * w < range.w) {
        d_p.y -= derivative_sums.w * fy * w * w;
        d_p.z += derivative_sums.w * fy * w * w * v;
    }

    let logit = value(LOGIT, i);
    let opacity = 1.0 / (1.0 + exp(-logit));
    var d_logit = g[0] / (1.0 + exp(logit));
    d_logit += opacity * (1.0 - opacity) * view.opacity_weight;
    d_log_scales += exp(log_scales) * view.scale_weight;
    if (view.flatness_weight > 0.0) {
        var thinnest = 0u;
        for (var k = 1u; k < 3u; k += 1u) {
            if (log_scales[k] < log_scales[thinnest]) {
                thinnest = k;
            }
        }
        d_log_scales[thinnest] += exp(log_scales[thinnest]) * view.flatness_weight;
    }

    let inverse = 1.0 / sqrt(max(dot(away, away), FLOOR));
    let direction = away * inverse;
    var terms = basis(view.degree, direction);
    let reached = vec3<f32>(
        select(0.0, g[6], record.color.x > 0.0),
        select(0.0, g[7], record.color.y > 0.0),
        select(0.0, g[8], record.color.z > 0.0),
    );
    var d_basis = array<f32, 16>();
    let used = (view.degree + 1u) * (view.degree + 1u);
    for (var k = 0u; k < used; k += 1u) {
        let column = SH + 3u * k;
        let coefficients = vec3<f32>(value(column, i), value(column + 1u, i), value(column + 2u, i));
        d_basis[k] = dot(coefficients, reached);
    }
    let d_direction = direction_backward(view.degree, direction, &d_basis);
    let d_seen_from = (d_direction - direction * dot(direction, d_direction)) * inverse;
    let d_mean = from_camera(d_p) + d_seen_from;
    if (view.with_pose != 0u) {
        for (var k = 0u; k < 3u; k += 1u) {
            d_pose[k * view.count + i] = d_p[k];
            let row = turning[k] + d_p[k] * away;
            for (var c = 0u; c < 3u; c += 1u) {
                d_pose[(3u + 3u * k + c) * view.count + i] = row[c];
            }
            d_pose[(12u + k) * view.count + i] = d_seen_from[k];
        }
    }
    for (var k = 0u; k < used; k += 1u) {
        let rate = select(view.rates[5], view.rates[4], k == 0u);
        for (var channel = 0u; channel < 3u; channel += 1u) {
            store_gradient(i, SH + 3u * k + channel, terms[k] * reached[channel], rate);
        }
    }
    for (var k = 0u; k < 3u; k += 1u) {
        store_gradient(i, MEAN + k, d_mean[k], view.rates[0]);
        store_gradient(i, LOG_SCALE + k, d_log_scales[k], view.rates[1]);
    }
    for (var k = 0u; k < 4u; k += 1u) {
        store_gradient(i, QUAT + k, d_quat[k], view.rates[2]);
    }
    store_gradient(i, LOGIT, d_logit, view.rates[3]);
}
