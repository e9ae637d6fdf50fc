// One invocation a Gaussian: its record, the key of its depth, and the number of tiles that it meets.

@group(0) @binding(0) var<storage, read> view: View;
@group(0) @binding(1) var<storage, read> plan: Plan;
@group(0) @binding(2) var<storage, read> values: array<f32>;
@group(0) @binding(3) var<storage, read_write> records: array<vec4<f32>>;  // four a Gaussian
@group(0) @binding(4) var<storage, read_write> keys: array<u32>;
@group(0) @binding(5) var<storage, read_write> counts: array<u32>;

fn usable(i: u32) -> bool {
    let mean = abs(mean_of(i));
    let scales = abs(log_scales_of(i));
    let quat = abs(quat_of(i));
    return abs(value(LOGIT, i)) < HUGE && all(mean < vec3<f32>(HUGE)) && all(scales < vec3<f32>(LARGEST_LOG_SCALE))
        && all(quat < vec4<f32>(HUGE));
}

fn ellipse(i: u32, record: ptr<function, Record>) -> bool {
    if (!usable(i)) {
        return false;
    }
    let p = to_camera(mean_of(i) - center());
    var log2_opacity = log2(max(1.0 / (1.0 + exp(-value(LOGIT, i))), FLOOR));
    if (!(p.z > plan.near && log2_opacity + LOG2_255 > 0.0)) {
        return false;
    }
    var scale = 1.0;
    let quat = unit_quat(quat_of(i), &scale);
    let c = covariance(quat, log_scales_of(i), derivative(p));
    let whole = c.w + LOW_PASS * (c.x + c.z) + LOW_PASS * LOW_PASS;
    let xx = c.x + LOW_PASS;
    let yy = c.z + LOW_PASS;
    if (max(xx, yy) > WIDEST) {
        return false;
    }
    let inverse = 1.0 / whole;
    if (view.antialiased != 0u) {
        log2_opacity += 0.5 * log2(max(c.w * inverse, THINNEST * THINNEST));
    }
    let reach = log2_opacity + LOG2_255;
    let listed = log2_opacity - log2(view.pair_alpha);
    if (!(reach > 0.0 && listed > 0.0)) {
        return false;
    }
    let inverse_z = 1.0 / p.z;
    (*record).mean = vec2<f32>(
        view.camera[12] * p.x * inverse_z + view.camera[14], view.camera[13] * p.y * inverse_z + view.camera[15]);
    (*record).conic = LOG2_E * inverse * vec3<f32>(0.5 * yy, -c.y, 0.5 * xx);
    (*record).log2_opacity = log2_opacity;
    (*record).depth = p.z;
    let squared = 2.0 * reach / LOG2_E;
    (*record).half = vec2<f32>(sqrt(squared * xx), sqrt(squared * yy));
    (*record).reach = listed;
    (*record).shrink = sqrt(listed / reach);
    return (*record).mean.x + (*record).half.x > 0.0 && (*record).mean.x - (*record).half.x < view.camera[16]
        && (*record).mean.y + (*record).half.y > 0.0 && (*record).mean.y - (*record).half.y < view.camera[17];
}

@compute @workgroup_size(256)
fn project(@builtin(global_invocation_id) id: vec3<u32>, @builtin(num_workgroups) groups: vec3<u32>) {
    let i = id.x + id.y * groups.x * 256u;
    if (i >= view.count) {
        return;
    }
    keys[i] = 0xffffffffu;
    counts[i] = 0u;
    var record: Record;
    if (plan.full != 0u || !ellipse(i, &record)) {
        return;
    }
    var tiles = 0u;
    let rows = tile_rows(record);
    for (var row = rows.x; row < rows.y; row += 1u) {
        let columns = tile_columns(record, row);
        if (view.literal == 0u) {
            tiles += columns.y - columns.x;
        } else {
            for (var column = columns.x; column < columns.y; column += 1u) {
                tiles += select(0u, 1u, holds_mean(record, row, column));
            }
        }
    }
    if (tiles == 0u) {
        return;
    }
    counts[i] = tiles;
    keys[i] = bitcast<u32>(record.depth);
    var away = mean_of(i) - center();
    away *= 1.0 / sqrt(max(dot(away, away), FLOOR));
    var terms = basis(view.degree, away);
    var color = vec3<f32>(0.5);
    for (var k = 0u; k < (view.degree + 1u) * (view.degree + 1u); k += 1u) {
        let column = SH + 3u * k;
        color += terms[k] * vec3<f32>(value(column, i), value(column + 1u, i), value(column + 2u, i));
    }
    color = max(color, vec3<f32>(0.0));
    records[4u * i] = vec4<f32>(record.mean, record.conic.xy);
    records[4u * i + 1u] = vec4<f32>(record.conic.z, record.log2_opacity, color.xy);
    records[4u * i + 2u] = vec4<f32>(color.z, record.depth, record.half);
    records[4u * i + 3u] = vec4<f32>(record.reach, record.shrink, 0.0, 0.0);
}
