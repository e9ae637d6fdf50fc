"""Gradients of the ellipses on the image → gradients of the Gaussians and of the camera's pose."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from ...compiled.blocks import BLOCK, next_block
from ...compiled.jit import kernel, njit, prange
from .harmonics import basis, direction_backward
from .project import LOW_PASS, THINNEST, covariance, direction, limits, rotation, to_camera
from .records import CONIC_A, CONIC_B, CONIC_C, DEPTH, HALF, LOG2_E, ONE, RED, TWO, ZERO

MOMENT = 16
USED_MOMENTS = 12
"""float32 values of one pair's gradients; twelve are used: Σv, Σv·dx, Σv·dy, Σv·dx², Σv·dx·dy, Σv·dy², where v is the
gradient of a pixel's exponent, then red, green, blue, depth, then Σ|·| of the gradients of the mean (x log2 e)."""


@njit
def _color_backward(
    i: int,
    means: NDArray[np.float32],
    sh: NDArray[np.float32],
    degree: int,
    camera: NDArray[np.float32],
    record: NDArray[np.float32],
    g: NDArray[np.float32],
    values: NDArray[np.float32],
    d_basis: NDArray[np.float32],
    d_sh: NDArray[np.float32],
) -> tuple[float, float, float]:
    """Gradients of a colour: with respect to `d_sh`, and to the mean through the viewing direction."""
    x, y, z, inverse = direction(means, i, camera)
    basis(degree, x, y, z, values)
    for k in range((degree + 1) * (degree + 1)):
        along = ZERO
        for c in range(3):
            if record[RED + c] > ZERO:
                d_sh[i, k, c] = values[k] * g[6 + c]
                along += sh[i, k, c] * g[6 + c]
        d_basis[k] = along
    dx, dy, dz = direction_backward(degree, x, y, z, d_basis)
    radial = x * dx + y * dy + z * dz
    return (dx - x * radial) * inverse, (dy - y * radial) * inverse, (dz - z * radial) * inverse


@njit
def _quaternion_backward(r: NDArray[np.float32], d: NDArray[np.float32], i: int, d_quats: NDArray[np.float32]) -> None:
    """Gradient of the rotation matrix (flat, row by row) with respect to the quaternion before normalisation."""
    w, x, y, z, scale = r[9], r[10], r[11], r[12], r[13]
    dw = TWO * (x * (d[7] - d[5]) + y * (d[2] - d[6]) + z * (d[3] - d[1]))
    dx = TWO * (y * (d[1] + d[3]) + z * (d[2] + d[6]) + w * (d[7] - d[5]) - TWO * x * (d[4] + d[8]))
    dy = TWO * (x * (d[1] + d[3]) + z * (d[5] + d[7]) + w * (d[2] - d[6]) - TWO * y * (d[0] + d[8]))
    dz = TWO * (x * (d[2] + d[6]) + y * (d[5] + d[7]) + w * (d[3] - d[1]) - TWO * z * (d[0] + d[4]))
    radial = w * dw + x * dx + y * dy + z * dz
    d_quats[i, 0] = (dw - w * radial) * scale
    d_quats[i, 1] = (dx - x * radial) * scale
    d_quats[i, 2] = (dy - y * radial) * scale
    d_quats[i, 3] = (dz - z * radial) * scale


@njit
def _conic_to_covariance(record: NDArray[np.float32], g: NDArray[np.float32]) -> tuple[float, float, float]:
    """Gradients of the conic K from the moments, with respect to the covariance K⁻¹: -K G K (xx, xy counted once,
    yy)."""
    a, b, c = TWO * record[CONIC_A] / LOG2_E, record[CONIC_B] / LOG2_E, TWO * record[CONIC_C] / LOG2_E
    ga, gb, gc = HALF * g[3], HALF * g[4], HALF * g[5]
    t00, t01 = a * ga + b * gb, a * gb + b * gc
    t10, t11 = b * ga + c * gb, b * gb + c * gc
    return t00 * a + t01 * b, TWO * (t00 * b + t01 * c), t10 * b + t11 * c


@njit
def _fading(
    i: int,
    log_scales: NDArray[np.float32],
    camera: NDArray[np.float32],
    r: NDArray[np.float32],
    j00: float,
    j02: float,
    j11: float,
    j12: float,
) -> tuple[float, float, float]:
    """Gradient of ½ ln(det C / det(C + 0.3 I)) with respect to C (xx, xy counted once, yy)."""
    xx, xy, yy, area = covariance(i, log_scales, camera, r, j00, j02, j11, j12)
    whole = ONE / (area + LOW_PASS * (xx + yy) + LOW_PASS * LOW_PASS)
    if area * whole <= THINNEST * THINNEST:
        return ZERO, ZERO, ZERO
    narrow = ONE / area
    return (
        HALF * (yy * narrow - (yy + LOW_PASS) * whole),
        -xy * (narrow - whole),
        HALF * (xx * narrow - (xx + LOW_PASS) * whole),
    )


@njit
def _add_outer(pose: NDArray[np.float32], x: float, y: float, z: float, a: float, b: float, c: float) -> None:
    """Add (x, y, z) · (a, b, c)ᵀ to the gradient of the camera's rotation, row by row in pose[3:12]."""
    pose[3] += x * a
    pose[4] += x * b
    pose[5] += x * c
    pose[6] += y * a
    pose[7] += y * b
    pose[8] += y * c
    pose[9] += z * a
    pose[10] += z * b
    pose[11] += z * c


@njit
def _from_camera(camera: NDArray[np.float32], x: float, y: float, z: float) -> tuple[float, float, float]:
    """A vector of the camera's frame in that of the world."""
    return (
        camera[0] * x + camera[3] * y + camera[6] * z,
        camera[1] * x + camera[4] * y + camera[7] * z,
        camera[2] * x + camera[5] * y + camera[8] * z,
    )


@njit
def _geometry_backward(
    i: int,
    means: NDArray[np.float32],
    log_scales: NDArray[np.float32],
    quats: NDArray[np.float32],
    antialiased: bool,
    camera: NDArray[np.float32],
    record: NDArray[np.float32],
    g: NDArray[np.float32],
    r: NDArray[np.float32],
    turned: NDArray[np.float32],
    d_log_scales: NDArray[np.float32],
    d_quats: NDArray[np.float32],
    d_offsets: NDArray[np.float32],
    pose: NDArray[np.float32],
) -> tuple[float, float, float]:
    """Gradients of an ellipse with respect to scales, rotation, offset and the position in the camera; those of the
    camera are added to `pose` (see `poses.twist_gradient`)."""
    px, py, pz = means[i, 0] - camera[18], means[i, 1] - camera[19], means[i, 2] - camera[20]
    x, y, _ = to_camera(camera, px, py, pz)
    z = record[DEPTH]
    fx, fy = camera[12], camera[13]
    left, right, top, bottom = limits(camera)
    w = ONE / z
    u = min(max(x * w, left), right)
    v = min(max(y * w, top), bottom)
    j00, j02, j11, j12 = fx * w, -fx * u * w, fy * w, -fy * v * w

    a, b, c = TWO * record[CONIC_A] / LOG2_E, record[CONIC_B] / LOG2_E, TWO * record[CONIC_C] / LOG2_E
    gx, gy = a * g[1] + b * g[2], b * g[1] + c * g[2]
    d_offsets[i, 0] = gx
    d_offsets[i, 1] = gy
    gxx, gxy, gyy = _conic_to_covariance(record, g)

    rotation(quats, i, r)
    if antialiased:
        axx, axy, ayy = _fading(i, log_scales, camera, r, j00, j02, j11, j12)
        gxx, gxy, gyy = gxx + g[0] * axx, gxy + g[0] * axy, gyy + g[0] * ayy
    d00, d02, d11, d12 = ZERO, ZERO, ZERO, ZERO
    for k in range(3):
        s = math.exp(log_scales[i, k])
        m0, m1, m2 = r[k] * s, r[3 + k] * s, r[6 + k] * s
        v0, v1, v2 = to_camera(camera, m0, m1, m2)
        p0, p1 = j00 * v0 + j02 * v2, j11 * v1 + j12 * v2
        dp0, dp1 = TWO * gxx * p0 + gxy * p1, TWO * gyy * p1 + gxy * p0
        d00 += dp0 * v0
        d02 += dp0 * v2
        d11 += dp1 * v1
        d12 += dp1 * v2
        dv0, dv1, dv2 = j00 * dp0, j11 * dp1, j02 * dp0 + j12 * dp1
        dm0, dm1, dm2 = _from_camera(camera, dv0, dv1, dv2)
        _add_outer(pose, dv0, dv1, dv2, m0, m1, m2)
        d_log_scales[i, k] = dm0 * m0 + dm1 * m1 + dm2 * m2
        turned[k], turned[3 + k], turned[6 + k] = dm0 * s, dm1 * s, dm2 * s
    _quaternion_backward(r, turned, i, d_quats)

    dx, dy = gx * fx * w, gy * fy * w
    dz = g[9] - (gx * fx * x + gy * fy * y) * w * w
    dz += -(d00 * fx + d11 * fy) * w * w + (d02 * fx * u + d12 * fy * v) * w * w
    if left < x * w and x * w < right:
        dx -= d02 * fx * w * w
        dz += d02 * fx * w * w * u
    if top < y * w and y * w < bottom:
        dy -= d12 * fy * w * w
        dz += d12 * fy * w * w * v
    pose[0] += dx
    pose[1] += dy
    pose[2] += dz
    _add_outer(pose, dx, dy, dz, px, py, pz)
    return dx, dy, dz


@kernel
def project_backward(
    workers: int,
    means: NDArray[np.float32],
    log_scales: NDArray[np.float32],
    quats: NDArray[np.float32],
    opacity_logits: NDArray[np.float32],
    sh: NDArray[np.float32],
    degree: int,
    antialiased: bool,
    camera: NDArray[np.float32],
    records: NDArray[np.float32],
    starts: NDArray[np.int64],
    counts: NDArray[np.int32],
    moments: NDArray[np.float32],
    d_means: NDArray[np.float32],
    d_log_scales: NDArray[np.float32],
    d_quats: NDArray[np.float32],
    d_opacity_logits: NDArray[np.float32],
    d_sh: NDArray[np.float32],
    d_offsets: NDArray[np.float32],
    mean_gradients: NDArray[np.float32],
    pose_sums: NDArray[np.float32],
) -> None:
    """Sum each Gaussian's pairs, in the order of its tiles, and propagate the sums to its parameters.

    starts, counts: (N,) where each Gaussian's pairs begin in moments (P, MOMENT) and how many they are. mean_gradients:
    (N, 2) sums over pixels of the absolute gradients of the projected means. Gaussians that were not drawn get 0 in
    d_offsets and mean_gradients; their rows in the others stay unchanged. pose_sums: (blocks, 15) see
    `poses.twist_gradient`, by block of Gaussians, so that the order is fixed.
    """
    n = means.shape[0]
    counter = np.zeros(1, np.int64)
    for _worker in prange(workers):
        g = np.empty(MOMENT, np.float32)
        values = np.empty(16, np.float32)
        d_basis = np.empty(16, np.float32)
        r = np.empty(14, np.float32)
        turned = np.empty(9, np.float32)
        begin, end = next_block(counter, n)
        while begin < end:
            pose = pose_sums[begin // BLOCK]
            pose[:] = ZERO
            for i in range(begin, end):
                d_offsets[i] = ZERO
                mean_gradients[i] = ZERO
                if counts[i] == 0:
                    continue
                d_sh[i] = ZERO
                record = records[i]
                g[:] = ZERO
                for pair in range(starts[i], starts[i] + counts[i]):
                    for k in range(USED_MOMENTS):
                        g[k] += moments[pair, k]
                d_opacity_logits[i] = g[0] / (ONE + math.exp(opacity_logits[i]))
                mean_gradients[i, 0] = g[10] / LOG2_E
                mean_gradients[i, 1] = g[11] / LOG2_E
                local = _geometry_backward(
                    i, means, log_scales, quats, antialiased, camera, record, g, r, turned, d_log_scales, d_quats,
                    d_offsets, pose,
                )  # fmt: skip
                dx, dy, dz = _color_backward(i, means, sh, degree, camera, record, g, values, d_basis, d_sh)
                pose[12] += dx
                pose[13] += dy
                pose[14] += dz
                x, y, z = _from_camera(camera, local[0], local[1], local[2])
                d_means[i, 0], d_means[i, 1], d_means[i, 2] = dx + x, dy + y, dz + z
            begin, end = next_block(counter, n)
