"""Real spherical harmonics of degree 0 to 3 and their derivatives, as 3DGS orders and signs them."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ...compiled.jit import njit

C0 = np.float32(0.28209479177387814)
C1 = np.float32(0.4886025119029199)
C2 = tuple(
    np.float32(value)
    for value in (1.0925484305920792, -1.0925484305920792, 0.31539156525252005, -1.0925484305920792, 0.5462742152960396)
)
C3 = tuple(
    np.float32(value)
    for value in (
        -0.5900435899266435,
        2.890611442640554,
        -0.4570457994644658,
        0.3731763325901154,
        -0.4570457994644658,
        1.445305721320277,
        -0.5900435899266435,
    )
)
TWO = np.float32(2)
THREE = np.float32(3)
FOUR = np.float32(4)
SIX = np.float32(6)
EIGHT = np.float32(8)


@njit
def basis(degree: int, x: float, y: float, z: float, out: NDArray[np.float32]) -> None:
    """Write the (degree + 1)² basis values for the unit direction (x, y, z)."""
    out[0] = C0
    if degree >= 1:
        out[1] = -C1 * y
        out[2] = C1 * z
        out[3] = -C1 * x
    if degree >= 2:
        out[4] = C2[0] * x * y
        out[5] = C2[1] * y * z
        out[6] = C2[2] * (TWO * z * z - x * x - y * y)
        out[7] = C2[3] * x * z
        out[8] = C2[4] * (x * x - y * y)
    if degree >= 3:
        out[9] = C3[0] * y * (THREE * x * x - y * y)
        out[10] = C3[1] * x * y * z
        out[11] = C3[2] * y * (FOUR * z * z - x * x - y * y)
        out[12] = C3[3] * z * (TWO * z * z - THREE * x * x - THREE * y * y)
        out[13] = C3[4] * x * (FOUR * z * z - x * x - y * y)
        out[14] = C3[5] * z * (x * x - y * y)
        out[15] = C3[6] * x * (x * x - THREE * y * y)


@njit
def direction_backward(
    degree: int, x: float, y: float, z: float, g: NDArray[np.float32]
) -> tuple[np.float32, np.float32, np.float32]:
    """Gradient with respect to (x, y, z) of Σ g[k]·basis[k], each basis function read as a polynomial."""
    dx = np.float32(0)
    dy = np.float32(0)
    dz = np.float32(0)
    if degree >= 1:
        dx -= C1 * g[3]
        dy -= C1 * g[1]
        dz += C1 * g[2]
    if degree >= 2:
        dx += C2[0] * y * g[4] - TWO * C2[2] * x * g[6] + C2[3] * z * g[7] + TWO * C2[4] * x * g[8]
        dy += C2[0] * x * g[4] + C2[1] * z * g[5] - TWO * C2[2] * y * g[6] - TWO * C2[4] * y * g[8]
        dz += C2[1] * y * g[5] + FOUR * C2[2] * z * g[6] + C2[3] * x * g[7]
    if degree >= 3:
        xx, yy, zz = x * x, y * y, z * z
        dx += C3[0] * SIX * x * y * g[9] + C3[1] * y * z * g[10] - C3[2] * TWO * x * y * g[11]
        dx += -C3[3] * SIX * x * z * g[12] + C3[4] * (FOUR * zz - THREE * xx - yy) * g[13]
        dx += C3[5] * TWO * x * z * g[14] + C3[6] * THREE * (xx - yy) * g[15]
        dy += C3[0] * THREE * (xx - yy) * g[9] + C3[1] * x * z * g[10] + C3[2] * (FOUR * zz - xx - THREE * yy) * g[11]
        dy += -C3[3] * SIX * y * z * g[12] - C3[4] * TWO * x * y * g[13]
        dy += -C3[5] * TWO * y * z * g[14] - C3[6] * SIX * x * y * g[15]
        dz += C3[1] * x * y * g[10] + C3[2] * EIGHT * y * z * g[11]
        dz += C3[3] * (SIX * zz - THREE * xx - THREE * yy) * g[12] + C3[4] * EIGHT * x * z * g[13]
        dz += C3[5] * (xx - yy) * g[14]
    return dx, dy, dz
