"""An affine colour change of an image, and its gradients, in a fixed order of summation."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ...compiled.jit import kernel, prange


@kernel
def change_colors(image: NDArray[np.float32], matrix: NDArray[np.float32], out: NDArray[np.float32]) -> None:
    """out (3, H, W) = matrix (3, 4) · (red, green, blue, 1) of image (3, H, W)."""
    for y in prange(image.shape[1]):
        for c in range(3):
            m0, m1, m2, m3 = matrix[c, 0], matrix[c, 1], matrix[c, 2], matrix[c, 3]
            for x in range(image.shape[2]):
                out[c, y, x] = m0 * image[0, y, x] + m1 * image[1, y, x] + m2 * image[2, y, x] + m3


@kernel
def colors_backward(
    image: NDArray[np.float32],
    matrix: NDArray[np.float32],
    gradient: NDArray[np.float32],
    row_sums: NDArray[np.float32],
) -> None:
    """Gradient (3, H, W) of the changed image → of the image, in place; and of the matrix, by row: (H, 3, 4)."""
    for y in prange(image.shape[1]):
        for c in range(3):
            for k in range(3):
                collected = np.float32(0)
                for x in range(image.shape[2]):
                    collected += gradient[c, y, x] * image[k, y, x]
                row_sums[y, c, k] = collected
            collected = np.float32(0)
            for x in range(image.shape[2]):
                collected += gradient[c, y, x]
            row_sums[y, c, 3] = collected
        for x in range(image.shape[2]):
            r, g, b = gradient[0, y, x], gradient[1, y, x], gradient[2, y, x]
            for k in range(3):
                gradient[k, y, x] = matrix[0, k] * r + matrix[1, k] * g + matrix[2, k] * b
