"""L1 and SSIM of an image against a photo, value and gradient in one pass (SSIM: Wang et al. 2004).

SSIM's windows are Gaussians of 11×11 pixels with σ = 1.5, one colour channel at a time, pixels outside the image 0. The
window is separable and its own adjoint, so the gradient takes three more blurs: with S = SSIM(μ, E[x²], E[xy]), dL/dx =
W·∂S/∂μ + 2x·W·∂S/∂E[x²] + y·W·∂S/∂E[xy].
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ...compiled.jit import kernel, njit, prange
from ...compiled.lanes import LANES, at_least, fill, load, select, store, total

RADIUS = 5
_window = np.exp(-0.5 * (np.arange(RADIUS + 1) / 1.5) ** 2)
_window /= 2 * _window.sum() - _window[0]
W0, W1, W2, W3, W4, W5 = (np.float32(weight) for weight in _window)
C1, C2 = np.float32(0.01**2), np.float32(0.03**2)
ZERO, ONE, TWO = np.float32(0), np.float32(1), np.float32(2)
TINY = np.float32(1e-12)


@njit
def _blur(plane: NDArray[np.float32], at: int, step: int):  # type: ignore[no-untyped-def]
    """LANES window sums around `at`, along a row (step 1) or a column (step = stride)."""
    result = load(plane, at) * W0
    result = result + (load(plane, at - step) + load(plane, at + step)) * W1
    result = result + (load(plane, at - 2 * step) + load(plane, at + 2 * step)) * W2
    result = result + (load(plane, at - 3 * step) + load(plane, at + 3 * step)) * W3
    result = result + (load(plane, at - 4 * step) + load(plane, at + 4 * step)) * W4
    return result + (load(plane, at - 5 * step) + load(plane, at + 5 * step)) * W5


@njit
def _fill_row(
    y: int,
    channel: int,
    image: NDArray[np.float32],
    photo: NDArray[np.uint8],
    mask: NDArray[np.bool_],
    planes: NDArray[np.float32],
    at: int,
) -> None:
    """Planes 0 image, 1 photo, 2 valid: where a pixel may not be used, the image equals the photo."""
    width = photo.shape[2]
    for x in range(width):
        planes[1, at + x] = np.float32(photo[channel, y, x]) * np.float32(1 / 255)
    if mask.shape[0] == 0:
        for x in range(width):
            planes[0, at + x] = image[channel, y, x]
            planes[2, at + x] = ONE
    else:
        for x in range(width):
            usable = mask[y, x]
            planes[0, at + x] = image[channel, y, x] if usable else planes[1, at + x]
            planes[2, at + x] = ONE if usable else ZERO


@njit
def _blur_products(planes: NDArray[np.float32], blurred: NDArray[np.float32], products: NDArray[np.float32], at: int,
                   end: int, known: bool) -> None:  # fmt: skip
    """Along one row: E of x, x², xy, and of y, y² unless they are known."""
    image, photo = planes[0], planes[1]
    xx, xy, yy = products[0], products[1], products[2]
    shift = LANES - at
    for k in range(at - LANES, end + LANES, LANES):
        x, y = load(image, k), load(photo, k)
        store(xx, k + shift, x * x)
        store(xy, k + shift, x * y)
        if not known:
            store(yy, k + shift, y * y)
    for k in range(at, end, LANES):
        store(blurred[0], k, _blur(image, k, 1))
        store(blurred[1], k, _blur(xx, k + shift, 1))
        store(blurred[2], k, _blur(xy, k + shift, 1))
        if not known:
            store(blurred[3], k, _blur(photo, k, 1))
            store(blurred[4], k, _blur(yy, k + shift, 1))


@njit
def _truth_row(
    blurred: NDArray[np.float32], mean: NDArray[np.float32], variance: NDArray[np.float32], at: int, end: int,
    stride: int,
) -> None:  # fmt: skip
    """The photo's window mean and variance along one row."""
    for k in range(at, end, LANES):
        my = _blur(blurred[3], k, stride)
        store(mean, k, my)
        store(variance, k, _blur(blurred[4], k, stride) - my * my)


@njit
def _ssim_row(
    planes: NDArray[np.float32],
    blurred: NDArray[np.float32],
    mean: NDArray[np.float32],
    variance: NDArray[np.float32],
    slopes: NDArray[np.float32],
    at: int,
    end: int,
    stride: int,
) -> float:
    """Sum of SSIM over a row's valid pixels; slopes ∂S/∂μ, ∂S/∂E[x²], ∂S/∂E[xy] for the gradient."""
    e_x, e_xx, e_xy = blurred[0], blurred[1], blurred[2]
    d_x, d_xx, d_xy, usable = slopes[0], slopes[1], slopes[2], planes[2]
    collected = fill(ZERO)
    for k in range(at, end, LANES):
        mx, my = _blur(e_x, k, stride), load(mean, k)
        vx, vy = _blur(e_xx, k, stride) - mx * mx, load(variance, k)
        covariance = _blur(e_xy, k, stride) - mx * my
        a1, a2 = mx * my * TWO + C1, covariance * TWO + C2
        b1, b2 = mx * mx + my * my + C1, vx + vy + C2
        inverse = load(usable, k) / (b1 * b2)
        s = a1 * a2 * inverse
        collected = collected + s
        store(d_x, k, (my * (a2 - a1) * inverse - s * mx * (ONE / b1 - ONE / b2)) * TWO)
        store(d_xx, k, ZERO - s / b2)
        store(d_xy, k, a1 * inverse * TWO)
    return total(collected)


@njit
def _l1_row(planes: NDArray[np.float32], at: int, end: int) -> float:
    image, photo = planes[0], planes[1]
    collected = fill(ZERO)
    for k in range(at, end, LANES):
        d = load(image, k) - load(photo, k)
        collected = collected + select(at_least(d, ZERO), d, ZERO - d)
    return total(collected)


@njit
def _blur_columns(slopes: NDArray[np.float32], fallen: NDArray[np.float32], at: int, end: int, stride: int) -> None:
    for plane in range(3):
        source, out = slopes[plane], fallen[plane]
        for k in range(at, end, LANES):
            store(out, k, _blur(source, k, stride))


@njit
def _gradient_row(
    y: int,
    channel: int,
    planes: NDArray[np.float32],
    fallen: NDArray[np.float32],
    l1_weight: float,
    ssim_weight: float,
    at: int,
    end: int,
    row: NDArray[np.float32],
    gradient: NDArray[np.float32],
) -> None:
    """Gradient of l1_weight · Σ|x - y| - ssim_weight · ΣS along one row."""
    image, photo, usable = planes[0], planes[1], planes[2]
    d_x, d_xx, d_xy = fallen[0], fallen[1], fallen[2]
    one = fill(ONE)
    for k in range(at, end, LANES):
        x, truth = load(image, k), load(photo, k)
        d = x - truth
        sign = select(at_least(d, TINY), one, select(at_least(ZERO - d, TINY), ZERO - one, fill(ZERO)))
        slope = _blur(d_x, k, 1) + x * _blur(d_xx, k, 1) * TWO + truth * _blur(d_xy, k, 1)
        store(row, k - at, (sign * l1_weight - slope * ssim_weight) * load(usable, k))
    for x in range(gradient.shape[2]):
        gradient[channel, y, x] = row[x]


def padded_size(height: int, width: int) -> int:
    """float32 values of a plane with its borders: rows of whole vectors with one on either side, RADIUS rows around."""
    return _stride(width) * (height + 2 * RADIUS)


@njit
def _stride(width: int) -> int:
    return (width + LANES - 1) // LANES * LANES + 2 * LANES


SCRATCH_PLANES = 14
"""Padded scratch planes of the loss."""


@kernel
def l1_and_ssim(
    image: NDArray[np.float32],
    photo: NDArray[np.uint8],
    mask: NDArray[np.bool_],
    l1_weight: float,
    ssim_weight: float,
    moments: NDArray[np.float32],
    known: bool,
    scratch: NDArray[np.float32],
    gradient: NDArray[np.float32],
    l1_sums: NDArray[np.float64],
    ssim_sums: NDArray[np.float64],
) -> None:
    """Sums by channel and row (3, H) of |x - y| and of SSIM over the valid pixels, and the gradient (3, H, W) of
    l1_weight · Σ|x - y| - ssim_weight · ΣSSIM.

    image, photo: (3, H, W); mask: (H, W) True where valid, or (0, 0) for all; moments: (2, 3, padded_size) the photo's
    window means and variances, written unless `known`; scratch: (SCRATCH_PLANES, padded_size), zeros or from an earlier
    call with the same size, because the borders are never written.
    """
    height, width = photo.shape[1], photo.shape[2]
    stride = _stride(width)
    planes, blurred, slopes, fallen = scratch[:3], scratch[3:8], scratch[8:11], scratch[11:14]
    for channel in range(3):
        mean, variance = moments[0, channel], moments[1, channel]
        for y in prange(height):
            at = (y + RADIUS) * stride + LANES
            end = at + stride - 2 * LANES
            _fill_row(y, channel, image, photo, mask, planes, at)
            l1_sums[channel, y] = _l1_row(planes, at, end)
            products = np.empty((3, stride), np.float32)
            _blur_products(planes, blurred, products, at, end, known)
        for y in prange(height):
            at = (y + RADIUS) * stride + LANES
            end = at + stride - 2 * LANES
            if not known:
                _truth_row(blurred, mean, variance, at, end, stride)
            ssim_sums[channel, y] = _ssim_row(planes, blurred, mean, variance, slopes, at, end, stride)
        for y in prange(height):
            at = (y + RADIUS) * stride + LANES
            end = at + stride - 2 * LANES
            _blur_columns(slopes, fallen, at, end, stride)
            row = np.empty(stride, np.float32)
            _gradient_row(y, channel, planes, fallen, l1_weight, ssim_weight, at, end, row, gradient)
