// Writes the tile and the Gaussian of every pair; then the beginning of every tile's list.

@group(0) @binding(0) var<storage, read> view: View;
@group(0) @binding(1) var<storage, read> plan: Plan;
@group(0) @binding(2) var<storage, read> records: array<vec4<f32>>;
@group(0) @binding(3) var<storage, read_write> counts: array<u32>;
@group(0) @binding(4) var<storage, read> starts: array<u32>;
@group(0) @binding(5) var<storage, read_write> tile_of: array<u32>;  // by pair; sorted when the lists are cut
@group(0) @binding(6) var<storage, read_write> owner_of: array<u32>;
@group(0) @binding(7) var<storage, read_write> tile_starts: array<u32>;

@compute @workgroup_size(256)
fn list_pairs(@builtin(global_invocation_id) id: vec3<u32>, @builtin(num_workgroups) groups: vec3<u32>) {
    let i = id.x + id.y * groups.x * 256u;
    if (i >= view.count || plan.pairs == 0u) {
        return;
    }
    let end = starts[i] + counts[i];
    var pair = starts[i];
    if (pair == end) {
        return;
    }
    let record = stored_ellipse(i);
    let rows = tile_rows(record);
    for (var row = rows.x; row < rows.y; row += 1u) {
        let columns = tile_columns(record, row);
        for (var column = columns.x; column < columns.y; column += 1u) {
            if (pair < end && (view.literal == 0u || holds_mean(record, row, column))) {
                tile_of[pair] = row * view.columns + column;
                owner_of[pair] = i;
                pair += 1u;
            }
        }
    }
    counts[i] = pair - starts[i];
    while (pair < end) {  // rounding may find a tile less than `project` did: behind the last list
        tile_of[pair] = view.columns * view.rows;
        owner_of[pair] = i;
        pair += 1u;
    }
}

@compute @workgroup_size(256)
fn cut_lists(@builtin(global_invocation_id) id: vec3<u32>, @builtin(num_workgroups) groups: vec3<u32>) {
    let entry = id.x + id.y * groups.x * 256u;
    if (entry >= plan.pairs) {
        return;
    }
    var begin = 0u;
    if (entry > 0u) {
        begin = tile_of[entry - 1u] + 1u;
    }
    for (var tile = begin; tile <= tile_of[entry]; tile += 1u) {
        tile_starts[tile] = entry;
    }
    if (entry + 1u == plan.pairs) {
        for (var tile = tile_of[entry] + 1u; tile <= view.columns * view.rows; tile += 1u) {
            tile_starts[tile] = plan.pairs;
        }
    }
}
