"""Gaussians → ellipses on the image, and the gradients back (EWA splatting; Zwicker et al. 2001, Kerbl et al. 2023).

A Gaussian with covariance Σ and camera position (x, y, z) becomes an ellipse with covariance J W Σ Wᵀ Jᵀ + 0.3 I, where
W rotates into the camera and J is the derivative of the projection. Its record holds what blending reads, exponents in
powers of two: α(d) = 2^(log2 opacity - (A dx² + B dx dy + C dy²)).
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..compiled import kernel, njit, prange
from .harmonics_kernels import basis, pull_direction
from .lanes import LANES, take

RECORD = 16
"""float32 values of a record: one cache line."""
(
    MEAN_X,
    MEAN_Y,
    CONIC_A,
    CONIC_B,
    CONIC_C,
    LOG2_OPACITY,
    RED,
    GREEN,
    BLUE,
    DEPTH,
    HALF_WIDTH,
    HALF_HEIGHT,
    REACH,
    SHRINK,
) = range(14)

MOMENT = 16
USED_MOMENTS = 12
"""float32 values of one pair's gradients; twelve are used: Σv, Σv·dx, Σv·dy, Σv·dx², Σv·dx·dy, Σv·dy², where v is the
gradient of a pixel's exponent, then red, green, blue, depth, then Σ|·| of the gradients of the mean (x log2 e)."""

TILE_WIDTH = LANES
TILE_HEIGHT = 16
BLOCK = 512
"""Gaussians a thread works on before it asks for more."""

LOW_PASS = np.float32(0.3)
MAX_QUATERNION_ERROR = np.float32(1e-24)
LOG2_E = np.float32(math.log2(math.e))
LOG2_255 = np.float32(math.log2(255.0))
THINNEST = np.float32(1e-6)
"""Least share of the opacity that a Gaussian thinner than a pixel keeps when antialiased; below nothing is drawn."""
SLACK = np.float32(1e-3)
"""Pixels added around each box, so that rounding never cuts off a pixel that blending would draw."""
ZERO, HALF, ONE, TWO = np.float32(0), np.float32(0.5), np.float32(1), np.float32(2)
MARGIN = np.float32(0.3)
FLOOR = np.float32(1e-12)
HUGE = np.float32(1e12)
LARGEST_LOG_SCALE = np.float32(30)
WIDEST = np.float32(1e12)
"""Gaussians wider than 10⁶ px (standard deviation, here squared) are not drawn: the camera is inside them."""


@njit
def _rotation(quats: NDArray[np.float32], i: int, r: NDArray[np.float32]) -> None:
    """Write the rotation matrix (row by row), the unit quaternion, and one over the length of the given one."""
    w, x, y, z = quats[i, 0], quats[i, 1], quats[i, 2], quats[i, 3]
    scale = ONE / math.sqrt(max(w * w + x * x + y * y + z * z, MAX_QUATERNION_ERROR))
    w, x, y, z = w * scale, x * scale, y * scale, z * scale
    r[0], r[1], r[2] = ONE - TWO * (y * y + z * z), TWO * (x * y - w * z), TWO * (x * z + w * y)
    r[3], r[4], r[5] = TWO * (x * y + w * z), ONE - TWO * (x * x + z * z), TWO * (y * z - w * x)
    r[6], r[7], r[8] = TWO * (x * z - w * y), TWO * (y * z + w * x), ONE - TWO * (x * x + y * y)
    r[9], r[10], r[11], r[12], r[13] = w, x, y, z, scale


@njit
def _limits(camera: NDArray[np.float32]) -> tuple[float, ...]:
    """Range of x/z and y/z used in J: the image and 0.3 half-images around it, where the linearisation still holds."""
    fx, fy, cx, cy, width, height = camera[12], camera[13], camera[14], camera[15], camera[16], camera[17]
    wide, high = MARGIN * HALF * width / fx, MARGIN * HALF * height / fy
    return -cx / fx - wide, (width - cx) / fx + wide, -cy / fy - high, (height - cy) / fy + high


@njit(fastmath=False)
def _band(record: NDArray[np.float32], top: float, bottom: float) -> tuple[float, float]:
    """Leftmost and rightmost x at which the ellipse α = τ meets the band top ≤ y ≤ bottom.

    Without fast arithmetic, as all that ends in a tile's number: it would assume that nothing is NaN.
    """
    a, b, c, reach = record[CONIC_A], record[CONIC_B], record[CONIC_C], record[REACH]
    low, high = top - record[MEAN_Y], bottom - record[MEAN_Y]
    extreme = b * record[HALF_WIDTH] * record[SHRINK] / (TWO * c)
    right_y = min(max(-extreme, low), high)
    left_y = min(max(extreme, low), high)
    right_root = math.sqrt(max(b * b * right_y * right_y - np.float32(4) * a * (c * right_y * right_y - reach), ZERO))
    left_root = math.sqrt(max(b * b * left_y * left_y - np.float32(4) * a * (c * left_y * left_y - reach), ZERO))
    inverse = HALF / a
    return (
        record[MEAN_X] + (-b * left_y - left_root) * inverse - SLACK,
        record[MEAN_X] + (-b * right_y + right_root) * inverse + SLACK,
    )


@njit(fastmath=False)
def tile_rows(record: NDArray[np.float32], height: int) -> tuple[int, int]:
    """First and last + 1 row of tiles that the ellipse meets."""
    half = record[HALF_HEIGHT] * record[SHRINK]
    first = max(math.ceil(record[MEAN_Y] - half - HALF - SLACK), 0)
    last = min(math.floor(record[MEAN_Y] + half - HALF + SLACK), height - 1)
    if not first <= last:
        return 0, 0
    return int(first) // TILE_HEIGHT, int(last) // TILE_HEIGHT + 1


@njit(fastmath=False)
def tile_columns(record: NDArray[np.float32], tile_row: int, width: int) -> tuple[int, int]:
    """First and last + 1 tile of a row of tiles that the ellipse meets (exactly: its extent within those rows)."""
    top = np.float32(tile_row * TILE_HEIGHT) + HALF
    half = record[HALF_HEIGHT] * record[SHRINK]
    top = max(top, record[MEAN_Y] - half)
    bottom = np.float32(tile_row * TILE_HEIGHT + TILE_HEIGHT) - HALF
    bottom = min(bottom, record[MEAN_Y] + half)
    if top > bottom + SLACK:
        return 0, 0
    left, right = _band(record, top, bottom)
    first = max(math.ceil(left - HALF), 0)
    last = min(math.floor(right - HALF), width - 1)
    if not first <= last:
        return 0, 0
    return int(first) // TILE_WIDTH, int(last) // TILE_WIDTH + 1


@njit
def holds_mean(record: NDArray[np.float32], tile_row: int, tile_column: int) -> bool:
    """Whether a Gaussian's projected mean lies in a tile."""
    x, y = record[MEAN_X] - np.float32(tile_column * TILE_WIDTH), record[MEAN_Y] - np.float32(tile_row * TILE_HEIGHT)
    return x >= ZERO and x < np.float32(TILE_WIDTH) and y >= ZERO and y < np.float32(TILE_HEIGHT)


@njit(fastmath=False)
def _usable(
    i: int,
    means: NDArray[np.float32],
    log_scales: NDArray[np.float32],
    quats: NDArray[np.float32],
    opacity_logits: NDArray[np.float32],
) -> bool:
    """Whether a Gaussian's values are numbers that nothing below overflows with (fast arithmetic cannot tell)."""
    good = abs(opacity_logits[i]) < HUGE
    for k in range(3):
        good = good and abs(means[i, k]) < HUGE and abs(log_scales[i, k]) < LARGEST_LOG_SCALE
    for k in range(4):
        good = good and abs(quats[i, k]) < HUGE
    return good


@njit(fastmath=False)
def box_tiles(record: NDArray[np.float32], width: int, height: int) -> int:
    """How many tiles the box around the ellipse meets: at least as many as the ellipse."""
    left = max(math.ceil(record[MEAN_X] - record[HALF_WIDTH] - HALF - SLACK), 0)
    right = min(math.floor(record[MEAN_X] + record[HALF_WIDTH] - HALF + SLACK), width - 1)
    first, last = tile_rows(record, height)
    if not left <= right:
        return 0
    return (last - first) * (int(right) // TILE_WIDTH - int(left) // TILE_WIDTH + 1)


@njit
def _project_one(
    i: int,
    means: NDArray[np.float32],
    log_scales: NDArray[np.float32],
    quats: NDArray[np.float32],
    opacity_logits: NDArray[np.float32],
    antialiased: bool,
    offsets: NDArray[np.float32],
    camera: NDArray[np.float32],
    near: float,
    pair_alpha: float,
    r: NDArray[np.float32],
    record: NDArray[np.float32],
) -> bool:
    """Write a Gaussian's ellipse (all but its colour); False when it cannot be seen."""
    if not _usable(i, means, log_scales, quats, opacity_logits):
        return False
    # From the camera's centre: far from the origin, R p + t would be a small difference of large numbers.
    px, py, pz = means[i, 0] - camera[18], means[i, 1] - camera[19], means[i, 2] - camera[20]
    x = camera[0] * px + camera[1] * py + camera[2] * pz
    y = camera[3] * px + camera[4] * py + camera[5] * pz
    z = camera[6] * px + camera[7] * py + camera[8] * pz
    log2_opacity = math.log2(max(ONE / (ONE + math.exp(-opacity_logits[i])), FLOOR))
    if not (z > near and log2_opacity + LOG2_255 > ZERO):
        return False
    _rotation(quats, i, r)
    fx, fy = camera[12], camera[13]
    left, right, top, bottom = _limits(camera)
    inverse_z = ONE / z
    u = min(max(x * inverse_z, left), right)
    v = min(max(y * inverse_z, top), bottom)
    j00, j02, j11, j12 = fx * inverse_z, -fx * u * inverse_z, fy * inverse_z, -fy * v * inverse_z
    xx, xy, yy, area = ZERO, ZERO, ZERO, ZERO
    q0, q1, o0, o1 = ZERO, ZERO, ZERO, ZERO
    for k in range(3):
        s = math.exp(log_scales[i, k])
        m0, m1, m2 = r[k] * s, r[3 + k] * s, r[6 + k] * s
        v0 = camera[0] * m0 + camera[1] * m1 + camera[2] * m2
        v1 = camera[3] * m0 + camera[4] * m1 + camera[5] * m2
        v2 = camera[6] * m0 + camera[7] * m1 + camera[8] * m2
        p0, p1 = j00 * v0 + j02 * v2, j11 * v1 + j12 * v2
        xx += p0 * p0
        xy += p0 * p1
        yy += p1 * p1
        # det C as the sum of squares that it is (Cauchy and Binet): no difference of large numbers.
        area += (q0 * p1 - q1 * p0) * (q0 * p1 - q1 * p0) + (o0 * p1 - o1 * p0) * (o0 * p1 - o1 * p0)
        q0, q1, o0, o1 = p0, p1, q0, q1
    # det(C + 0.3 I) = det C + 0.3 trace C + 0.09
    whole = area + LOW_PASS * (xx + yy) + LOW_PASS * LOW_PASS
    xx += LOW_PASS
    yy += LOW_PASS
    if max(xx, yy) > WIDEST:
        return False
    inverse = ONE / whole
    if antialiased:
        log2_opacity += HALF * math.log2(max(area * inverse, THINNEST * THINNEST))
    reach = log2_opacity + LOG2_255
    listed = log2_opacity - math.log2(pair_alpha)
    if not (reach > ZERO and listed > ZERO):
        return False
    record[MEAN_X] = fx * x * inverse_z + camera[14]
    record[MEAN_Y] = fy * y * inverse_z + camera[15]
    if offsets.shape[0] > 0:
        record[MEAN_X] += offsets[i, 0]
        record[MEAN_Y] += offsets[i, 1]
    record[CONIC_A] = HALF * LOG2_E * yy * inverse
    record[CONIC_B] = -LOG2_E * xy * inverse
    record[CONIC_C] = HALF * LOG2_E * xx * inverse
    record[LOG2_OPACITY] = log2_opacity
    record[DEPTH] = z
    squared = TWO * reach / LOG2_E
    record[HALF_WIDTH] = math.sqrt(squared * xx)
    record[HALF_HEIGHT] = math.sqrt(squared * yy)
    record[REACH] = listed
    record[SHRINK] = math.sqrt(listed / reach)
    return (
        record[MEAN_X] + record[HALF_WIDTH] > ZERO
        and record[MEAN_X] - record[HALF_WIDTH] < camera[16]
        and record[MEAN_Y] + record[HALF_HEIGHT] > ZERO
        and record[MEAN_Y] - record[HALF_HEIGHT] < camera[17]
    )


@njit
def _direction(means: NDArray[np.float32], i: int, camera: NDArray[np.float32]) -> tuple[Any, Any, Any, Any]:
    """Unit direction from the camera to a Gaussian, and one over its distance."""
    x, y, z = means[i, 0] - camera[18], means[i, 1] - camera[19], means[i, 2] - camera[20]
    inverse = ONE / math.sqrt(max(x * x + y * y + z * z, FLOOR))
    return x * inverse, y * inverse, z * inverse, inverse


@kernel
def project(
    workers: int,
    means: NDArray[np.float32],
    log_scales: NDArray[np.float32],
    quats: NDArray[np.float32],
    opacity_logits: NDArray[np.float32],
    sh: NDArray[np.float32],
    degree: int,
    antialiased: bool,
    offsets: NDArray[np.float32],
    camera: NDArray[np.float32],
    near: float,
    pair_alpha: float,
    records: NDArray[np.float32],
    room: NDArray[np.int32],
) -> None:
    """Fill records (N, RECORD) and room (N,): how many tiles each Gaussian's box meets, 0 for those not drawn.

    antialiased: opacity · √(det C / det(C + 0.3 I)) for opacity; offsets: (N, 2) px added to the projected means, or
    (0, 2); camera: (21,) see `drawing.camera_values`; near: float32, depth up to which nothing is drawn; pair_alpha:
    float32, α from which a Gaussian is listed in a tile, at least 1/255.
    """
    n = means.shape[0]
    terms = (degree + 1) * (degree + 1)
    height = int(camera[17])
    width = int(camera[16])
    blocks = (n + BLOCK - 1) // BLOCK
    counter = np.zeros(1, np.int64)
    for _worker in prange(workers):
        values = np.empty(16, np.float32)
        r = np.empty(14, np.float32)
        while True:
            block = take(counter)
            if block >= blocks:
                break
            for i in range(block * BLOCK, min((block + 1) * BLOCK, n)):
                record = records[i]
                room[i] = 0
                if not _project_one(
                    i,
                    means,
                    log_scales,
                    quats,
                    opacity_logits,
                    antialiased,
                    offsets,
                    camera,
                    near,
                    pair_alpha,
                    r,
                    record,
                ):
                    continue
                room[i] = box_tiles(record, width, height)
                if room[i] == 0:
                    continue
                x, y, z, _ = _direction(means, i, camera)
                basis(degree, x, y, z, values)
                for c in range(3):
                    color = HALF
                    for k in range(terms):
                        color += values[k] * sh[i, k, c]
                    record[RED + c] = max(color, ZERO)


@njit
def _pull_color(
    i: int,
    means: NDArray[np.float32],
    sh: NDArray[np.float32],
    degree: int,
    camera: NDArray[np.float32],
    record: NDArray[np.float32],
    g: NDArray[np.float32],
    values: NDArray[np.float32],
    pulled: NDArray[np.float32],
    d_sh: NDArray[np.float32],
) -> tuple[float, float, float]:
    """Gradients of a colour: into `d_sh`, and with respect to the mean through the viewing direction."""
    x, y, z, inverse = _direction(means, i, camera)
    basis(degree, x, y, z, values)
    for k in range((degree + 1) * (degree + 1)):
        along = ZERO
        for c in range(3):
            if record[RED + c] > ZERO:
                d_sh[i, k, c] = values[k] * g[6 + c]
                along += sh[i, k, c] * g[6 + c]
        pulled[k] = along
    dx, dy, dz = pull_direction(degree, x, y, z, pulled)
    radial = x * dx + y * dy + z * dz
    return (dx - x * radial) * inverse, (dy - y * radial) * inverse, (dz - z * radial) * inverse


@njit
def _pull_quaternion(r: NDArray[np.float32], d: NDArray[np.float32], i: int, d_quats: NDArray[np.float32]) -> None:
    """Gradient of the rotation matrix (flat, row by row) into the quaternion that was not yet of unit length."""
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
    """Gradients of the conic K from the moments, pulled to the covariance K⁻¹: -K G K (xx, xy counted once, yy)."""
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
    xx, xy, yy, area = ZERO, ZERO, ZERO, ZERO
    q0, q1, o0, o1 = ZERO, ZERO, ZERO, ZERO
    for k in range(3):
        s = math.exp(log_scales[i, k])
        m0, m1, m2 = r[k] * s, r[3 + k] * s, r[6 + k] * s
        v0 = camera[0] * m0 + camera[1] * m1 + camera[2] * m2
        v1 = camera[3] * m0 + camera[4] * m1 + camera[5] * m2
        v2 = camera[6] * m0 + camera[7] * m1 + camera[8] * m2
        p0, p1 = j00 * v0 + j02 * v2, j11 * v1 + j12 * v2
        xx += p0 * p0
        xy += p0 * p1
        yy += p1 * p1
        area += (q0 * p1 - q1 * p0) * (q0 * p1 - q1 * p0) + (o0 * p1 - o1 * p0) * (o0 * p1 - o1 * p0)
        q0, q1, o0, o1 = p0, p1, q0, q1
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
def _pull_geometry(
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
    """Gradients of an ellipse: into scales, rotation and offset, and with respect to the position in the camera; the
    camera's own are added to `pose` (see `poses.twist_gradient`)."""
    px, py, pz = means[i, 0] - camera[18], means[i, 1] - camera[19], means[i, 2] - camera[20]
    x = camera[0] * px + camera[1] * py + camera[2] * pz
    y = camera[3] * px + camera[4] * py + camera[5] * pz
    z = record[DEPTH]
    fx, fy = camera[12], camera[13]
    left, right, top, bottom = _limits(camera)
    w = ONE / z
    u = min(max(x * w, left), right)
    v = min(max(y * w, top), bottom)
    j00, j02, j11, j12 = fx * w, -fx * u * w, fy * w, -fy * v * w

    a, b, c = TWO * record[CONIC_A] / LOG2_E, record[CONIC_B] / LOG2_E, TWO * record[CONIC_C] / LOG2_E
    gx, gy = a * g[1] + b * g[2], b * g[1] + c * g[2]
    d_offsets[i, 0] = gx
    d_offsets[i, 1] = gy
    gxx, gxy, gyy = _conic_to_covariance(record, g)

    _rotation(quats, i, r)
    if antialiased:
        axx, axy, ayy = _fading(i, log_scales, camera, r, j00, j02, j11, j12)
        gxx, gxy, gyy = gxx + g[0] * axx, gxy + g[0] * axy, gyy + g[0] * ayy
    d00, d02, d11, d12 = ZERO, ZERO, ZERO, ZERO
    for k in range(3):
        s = math.exp(log_scales[i, k])
        m0, m1, m2 = r[k] * s, r[3 + k] * s, r[6 + k] * s
        v0 = camera[0] * m0 + camera[1] * m1 + camera[2] * m2
        v1 = camera[3] * m0 + camera[4] * m1 + camera[5] * m2
        v2 = camera[6] * m0 + camera[7] * m1 + camera[8] * m2
        p0, p1 = j00 * v0 + j02 * v2, j11 * v1 + j12 * v2
        dp0, dp1 = TWO * gxx * p0 + gxy * p1, TWO * gyy * p1 + gxy * p0
        d00 += dp0 * v0
        d02 += dp0 * v2
        d11 += dp1 * v1
        d12 += dp1 * v2
        dv0, dv1, dv2 = j00 * dp0, j11 * dp1, j02 * dp0 + j12 * dp1
        dm0 = camera[0] * dv0 + camera[3] * dv1 + camera[6] * dv2
        dm1 = camera[1] * dv0 + camera[4] * dv1 + camera[7] * dv2
        dm2 = camera[2] * dv0 + camera[5] * dv1 + camera[8] * dv2
        pose[3] += dv0 * m0
        pose[4] += dv0 * m1
        pose[5] += dv0 * m2
        pose[6] += dv1 * m0
        pose[7] += dv1 * m1
        pose[8] += dv1 * m2
        pose[9] += dv2 * m0
        pose[10] += dv2 * m1
        pose[11] += dv2 * m2
        d_log_scales[i, k] = dm0 * m0 + dm1 * m1 + dm2 * m2
        turned[k], turned[3 + k], turned[6 + k] = dm0 * s, dm1 * s, dm2 * s
    _pull_quaternion(r, turned, i, d_quats)

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
    pose[3] += dx * px
    pose[4] += dx * py
    pose[5] += dx * pz
    pose[6] += dy * px
    pose[7] += dy * py
    pose[8] += dy * pz
    pose[9] += dz * px
    pose[10] += dz * py
    pose[11] += dz * pz
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
    pulls: NDArray[np.float32],
    pose_sums: NDArray[np.float32],
) -> None:
    """Add up each Gaussian's pairs, in the order of its tiles, and pull the sums back to its parameters.

    starts, counts: (N,) where each Gaussian's pairs begin in moments (P, MOMENT) and how many they are.
    pulls: (N, 2) sums over pixels of the absolute gradients of the projected means. What is not drawn gets 0 in
    d_offsets and pulls; its rows in the others stay as they were. pose_sums: (blocks, 15) see `poses.twist_gradient`,
    by block of Gaussians, so that their order is fixed.
    """
    n = means.shape[0]
    blocks = (n + BLOCK - 1) // BLOCK
    counter = np.zeros(1, np.int64)
    for _worker in prange(workers):
        g = np.empty(MOMENT, np.float32)
        values = np.empty(16, np.float32)
        pulled = np.empty(16, np.float32)
        r = np.empty(14, np.float32)
        turned = np.empty(9, np.float32)
        while True:
            block = take(counter)
            if block >= blocks:
                break
            pose = pose_sums[block]
            pose[:] = ZERO
            for i in range(block * BLOCK, min((block + 1) * BLOCK, n)):
                d_offsets[i] = ZERO
                pulls[i] = ZERO
                if counts[i] == 0:
                    continue
                d_sh[i] = ZERO
                record = records[i]
                g[:] = ZERO
                for pair in range(starts[i], starts[i] + counts[i]):
                    for k in range(USED_MOMENTS):
                        g[k] += moments[pair, k]
                d_opacity_logits[i] = g[0] / (ONE + math.exp(opacity_logits[i]))
                pulls[i, 0] = g[10] / LOG2_E
                pulls[i, 1] = g[11] / LOG2_E
                x, y, z = _pull_geometry(
                    i, means, log_scales, quats, antialiased, camera, record, g, r, turned, d_log_scales, d_quats,
                    d_offsets, pose,
                )  # fmt: skip
                dx, dy, dz = _pull_color(i, means, sh, degree, camera, record, g, values, pulled, d_sh)
                pose[12] += dx
                pose[13] += dy
                pose[14] += dz
                d_means[i, 0] = dx + camera[0] * x + camera[3] * y + camera[6] * z
                d_means[i, 1] = dy + camera[1] * x + camera[4] * y + camera[7] * z
                d_means[i, 2] = dz + camera[2] * x + camera[5] * y + camera[8] * z
