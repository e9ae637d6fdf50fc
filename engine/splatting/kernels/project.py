"""Gaussians → ellipses on the image (EWA splatting; Zwicker et al. 2001, Kerbl et al. 2023).

A Gaussian with covariance Σ and camera position (x, y, z) becomes an ellipse with covariance J W Σ Wᵀ Jᵀ + 0.3 I, where
W rotates into the camera and J is the derivative of the projection.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...compiled.blocks import next_block
from ...compiled.jit import kernel, njit, prange
from .harmonics import basis
from .records import (
    CONIC_A,
    CONIC_B,
    CONIC_C,
    DEPTH,
    HALF,
    HALF_HEIGHT,
    HALF_WIDTH,
    LOG2_255,
    LOG2_E,
    LOG2_OPACITY,
    MEAN_X,
    MEAN_Y,
    ONE,
    REACH,
    RED,
    SHRINK,
    TWO,
    ZERO,
    box_tiles,
)

LOW_PASS = np.float32(0.3)
"""Variance in px² added to every ellipse, so that none falls between pixels."""
MAX_QUATERNION_ERROR = np.float32(1e-24)
THINNEST = np.float32(1e-6)
"""Least share of the opacity of a Gaussian thinner than a pixel when antialiased; with less it is not drawn."""
MARGIN = np.float32(0.3)
FLOOR = np.float32(1e-12)
HUGE = np.float32(1e12)
LARGEST_LOG_SCALE = np.float32(30)
WIDEST = np.float32(1e12)
"""Gaussians wider than 10⁶ px (standard deviation, here squared) are not drawn: the camera is inside them."""


@njit(fastmath=False)
def _is_usable(
    i: int,
    means: NDArray[np.float32],
    log_scales: NDArray[np.float32],
    quats: NDArray[np.float32],
    opacity_logits: NDArray[np.float32],
) -> bool:
    """Whether the values of a Gaussian do not overflow below (fast arithmetic cannot detect it)."""
    good = abs(opacity_logits[i]) < HUGE
    for k in range(3):
        good = good and abs(means[i, k]) < HUGE and abs(log_scales[i, k]) < LARGEST_LOG_SCALE
    for k in range(4):
        good = good and abs(quats[i, k]) < HUGE
    return good


@njit
def rotation(quats: NDArray[np.float32], i: int, r: NDArray[np.float32]) -> None:
    """Write the rotation matrix (row by row), the unit quaternion, and one over the length of the given one."""
    w, x, y, z = quats[i, 0], quats[i, 1], quats[i, 2], quats[i, 3]
    scale = ONE / math.sqrt(max(w * w + x * x + y * y + z * z, MAX_QUATERNION_ERROR))
    w, x, y, z = w * scale, x * scale, y * scale, z * scale
    r[0], r[1], r[2] = ONE - TWO * (y * y + z * z), TWO * (x * y - w * z), TWO * (x * z + w * y)
    r[3], r[4], r[5] = TWO * (x * y + w * z), ONE - TWO * (x * x + z * z), TWO * (y * z - w * x)
    r[6], r[7], r[8] = TWO * (x * z - w * y), TWO * (y * z + w * x), ONE - TWO * (x * x + y * y)
    r[9], r[10], r[11], r[12], r[13] = w, x, y, z, scale


@njit
def limits(camera: NDArray[np.float32]) -> tuple[float, ...]:
    """Range of x/z and y/z used in J: the image and 0.3 half-images around it, where the linearisation is accurate."""
    fx, fy, cx, cy, width, height = camera[12], camera[13], camera[14], camera[15], camera[16], camera[17]
    wide, high = MARGIN * HALF * width / fx, MARGIN * HALF * height / fy
    return -cx / fx - wide, (width - cx) / fx + wide, -cy / fy - high, (height - cy) / fy + high


@njit
def direction(means: NDArray[np.float32], i: int, camera: NDArray[np.float32]) -> tuple[Any, Any, Any, Any]:
    """Unit direction from the camera to a Gaussian, and one over its distance."""
    x, y, z = means[i, 0] - camera[18], means[i, 1] - camera[19], means[i, 2] - camera[20]
    inverse = ONE / math.sqrt(max(x * x + y * y + z * z, FLOOR))
    return x * inverse, y * inverse, z * inverse, inverse


@njit
def to_camera(camera: NDArray[np.float32], x: float, y: float, z: float) -> tuple[float, float, float]:
    """A vector of the world in the camera's frame."""
    return (
        camera[0] * x + camera[1] * y + camera[2] * z,
        camera[3] * x + camera[4] * y + camera[5] * z,
        camera[6] * x + camera[7] * y + camera[8] * z,
    )


@njit
def covariance(
    i: int,
    log_scales: NDArray[np.float32],
    camera: NDArray[np.float32],
    r: NDArray[np.float32],
    j00: float,
    j02: float,
    j11: float,
    j12: float,
) -> tuple[float, float, float, float]:
    """Covariance C = J W Σ Wᵀ Jᵀ of an ellipse, in px², before it is widened: xx, xy, yy and its determinant."""
    xx, xy, yy, area = ZERO, ZERO, ZERO, ZERO
    q0, q1, o0, o1 = ZERO, ZERO, ZERO, ZERO
    for k in range(3):
        s = math.exp(log_scales[i, k])
        m0, m1, m2 = r[k] * s, r[3 + k] * s, r[6 + k] * s
        v0, v1, v2 = to_camera(camera, m0, m1, m2)
        p0, p1 = j00 * v0 + j02 * v2, j11 * v1 + j12 * v2
        xx += p0 * p0
        xy += p0 * p1
        yy += p1 * p1
        # det C as a sum of squares (Cauchy-Binet): no difference of large numbers.
        area += (q0 * p1 - q1 * p0) * (q0 * p1 - q1 * p0) + (o0 * p1 - o1 * p0) * (o0 * p1 - o1 * p0)
        q0, q1, o0, o1 = p0, p1, q0, q1
    return xx, xy, yy, area


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
    """Write a Gaussian's ellipse (all but its colour); False if it is not visible."""
    if not _is_usable(i, means, log_scales, quats, opacity_logits):
        return False
    # Relative to the camera's centre: far from the origin, R p + t would be a small difference of large numbers.
    px, py, pz = means[i, 0] - camera[18], means[i, 1] - camera[19], means[i, 2] - camera[20]
    x, y, z = to_camera(camera, px, py, pz)
    log2_opacity = math.log2(max(ONE / (ONE + math.exp(-opacity_logits[i])), FLOOR))
    if not (z > near and log2_opacity + LOG2_255 > ZERO):
        return False
    rotation(quats, i, r)
    fx, fy = camera[12], camera[13]
    left, right, top, bottom = limits(camera)
    inverse_z = ONE / z
    u = min(max(x * inverse_z, left), right)
    v = min(max(y * inverse_z, top), bottom)
    j00, j02, j11, j12 = fx * inverse_z, -fx * u * inverse_z, fy * inverse_z, -fy * v * inverse_z
    xx, xy, yy, area = covariance(i, log_scales, camera, r, j00, j02, j11, j12)
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
    """Fill records (N, RECORD) and room (N,): number of tiles that each Gaussian's box meets, 0 if not drawn.

    antialiased: opacity · √(det C / det(C + 0.3 I)) for opacity; offsets: (N, 2) px added to the projected means, or
    (0, 2); camera: (21,) see `render.camera_values`; near: float32, depth up to which nothing is drawn; pair_alpha:
    float32, least α at which a Gaussian is listed in a tile, at least 1/255.
    """
    n = means.shape[0]
    terms = (degree + 1) * (degree + 1)
    height = int(camera[17])
    width = int(camera[16])
    counter = np.zeros(1, np.int64)
    for _worker in prange(workers):
        values = np.empty(16, np.float32)
        r = np.empty(14, np.float32)
        begin, end = next_block(counter, n)
        while begin < end:
            for i in range(begin, end):
                record = records[i]
                room[i] = 0
                if not _project_one(
                    i, means, log_scales, quats, opacity_logits, antialiased, offsets, camera, near, pair_alpha,
                    r, record,
                ):  # fmt: skip
                    continue
                room[i] = box_tiles(record, width, height)
                if room[i] == 0:
                    continue
                x, y, z, _ = direction(means, i, camera)
                basis(degree, x, y, z, values)
                for c in range(3):
                    color = HALF
                    for k in range(terms):
                        color += values[k] * sh[i, k, c]
                    record[RED + c] = max(color, ZERO)
            begin, end = next_block(counter, n)
