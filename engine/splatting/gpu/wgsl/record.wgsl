// The record of a Gaussian for blending, and the tiles that its ellipse meets (kernels/records.py).

struct Record {
    mean: vec2<f32>,
    conic: vec3<f32>,  // A, B, C: α(d) = 2^(log2 opacity - (A dx² + B dx dy + C dy²))
    log2_opacity: f32,
    color: vec3<f32>,
    depth: f32,
    half: vec2<f32>,  // half the sides of the box in which α ≥ 1/255
    reach: f32,
    shrink: f32,
}

// The ellipse that `project` stored.
fn stored_ellipse(i: u32) -> Record {
    let one = records[4u * i];
    let two = records[4u * i + 1u];
    let three = records[4u * i + 2u];
    let four = records[4u * i + 3u];
    var record: Record;
    record.mean = one.xy;
    record.conic = vec3<f32>(one.zw, two.x);
    record.log2_opacity = two.y;
    record.color = vec3<f32>(two.zw, three.x);
    record.depth = three.y;
    record.half = three.zw;
    record.reach = four.x;
    record.shrink = four.y;
    return record;
}

// First and last + 1 row of tiles that an ellipse meets.
fn tile_rows(record: Record) -> vec2<u32> {
    let half = record.half.y * record.shrink;
    let first = max(ceil(record.mean.y - half - 0.5 - SLACK), 0.0);
    let last = min(floor(record.mean.y + half - 0.5 + SLACK), f32(view.height) - 1.0);
    if (!(first <= last)) {
        return vec2<u32>(0u, 0u);
    }
    return vec2<u32>(u32(first) / TILE, u32(last) / TILE + 1u);
}

// First and last + 1 tile of a row of tiles that an ellipse meets.
fn tile_columns(record: Record, row: u32) -> vec2<u32> {
    let half = record.half.y * record.shrink;
    let top = max(f32(row * TILE) + 0.5, record.mean.y - half);
    let bottom = min(f32(row * TILE + TILE) - 0.5, record.mean.y + half);
    if (top > bottom + SLACK) {
        return vec2<u32>(0u, 0u);
    }
    let a = record.conic.x;
    let b = record.conic.y;
    let c = record.conic.z;
    let low = top - record.mean.y;
    let high = bottom - record.mean.y;
    let extreme = b * record.half.x * record.shrink / (2.0 * c);
    let right_y = min(max(-extreme, low), high);
    let left_y = min(max(extreme, low), high);
    let right_root = sqrt(max(b * b * right_y * right_y - 4.0 * a * (c * right_y * right_y - record.reach), 0.0));
    let left_root = sqrt(max(b * b * left_y * left_y - 4.0 * a * (c * left_y * left_y - record.reach), 0.0));
    let left = record.mean.x + (-b * left_y - left_root) * (0.5 / a) - SLACK;
    let right = record.mean.x + (-b * right_y + right_root) * (0.5 / a) + SLACK;
    let first = max(ceil(left - 0.5), 0.0);
    let last = min(floor(right - 0.5), f32(view.width) - 1.0);
    if (!(first <= last)) {
        return vec2<u32>(0u, 0u);
    }
    return vec2<u32>(u32(first) / TILE, u32(last) / TILE + 1u);
}

// Whether the projected mean lies in a tile (eq. 3 as it is printed).
fn holds_mean(record: Record, row: u32, column: u32) -> bool {
    let inside = record.mean - vec2<f32>(f32(column * TILE), f32(row * TILE));
    return inside.x >= 0.0 && inside.x < f32(TILE) && inside.y >= 0.0 && inside.y < f32(TILE);
}
