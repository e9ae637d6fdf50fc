// The gradient of the camera's pose, summed over the Gaussians: one workgroup for each of its numbers.

@group(0) @binding(0) var<storage, read> view: View;
@group(0) @binding(1) var<storage, read> plan: Plan;
@group(0) @binding(2) var<storage, read> d_pose: array<f32>;  // (15, N)
@group(0) @binding(3) var<storage, read_write> pose_sums: array<f32>;  // (slots, 15) see poses.twist_gradient

@compute @workgroup_size(256)
fn sum_pose(@builtin(local_invocation_index) own: u32, @builtin(workgroup_id) group: vec3<u32>) {
    var sum = 0.0;
    for (var i = own; i < view.count; i += 256u) {
        sum += d_pose[group.x * view.count + i];
    }
    let whole = total(own, sum);
    if (own == 0u && plan.full == 0u) {
        pose_sums[view.slot * 15u + group.x] = whole;
    }
}
