"""HDR video as sRGB: the transfer functions PQ and HLG of BT.2100, the colours of BT.2020, and a tone curve."""

from __future__ import annotations

import functools

import numpy as np
from numpy.typing import NDArray

PQ, HLG = "PQ", "HLG"
TRANSFERS = {16: PQ, 18: HLG}
"""Transfer characteristics of ITU-T H.273."""
_WHITE = 203.0
"""cd/m² of white paper (BT.2408); shown as bright as white in sRGB, but for the highlights above it."""
_HLG_PEAK = 1000.0
_KNEE = 0.6
"""Share of white up to which brightness stays as it is; above it is compressed."""
_TO_BT709 = np.array(
    [[1.6605, -0.5876, -0.0728], [-0.1246, 1.1329, -0.0083], [-0.0182, -0.1006, 1.1187]], dtype=np.float32
)
"""Linear BT.2020 to linear BT.709 (BT.2087)."""
_LUMINANCE = np.array([0.2627, 0.6780, 0.0593], dtype=np.float32)


def to_srgb(pixels: NDArray[np.uint16], transfer: str) -> NDArray[np.uint8]:
    """(H, W, 3) sRGB of 16-bit BT.2020 pixels, with their hue; `transfer` is PQ or HLG."""
    light = _build_light_table(transfer)[pixels]
    if transfer == HLG:  # the system gamma of a screen of 1000 cd/m²
        light *= np.maximum(light @ _LUMINANCE, 1e-6)[..., None] ** np.float32(0.2) * np.float32(_HLG_PEAK / _WHITE)
    light = np.maximum(light @ _TO_BT709.T, 0.0)
    brightest = light.max(axis=2, keepdims=True)
    above = np.maximum(brightest - _KNEE, 0.0) / (1.0 - _KNEE)
    toned = np.minimum(brightest, _KNEE) + (1.0 - _KNEE) * -np.expm1(-above)
    light *= toned / np.maximum(brightest, 1e-6)
    return _build_srgb_table()[np.rint(light * 65535.0).astype(np.uint16)]


@functools.cache
def _build_light_table(transfer: str) -> NDArray[np.float32]:
    """Build the table (65536,) of light of a 16-bit value: in shares of white for PQ, of the scene's peak for HLG."""
    value = np.arange(65536) / 65535.0
    if transfer == PQ:
        m1, m2, c1, c2, c3 = 1305 / 8192, 2523 / 32, 107 / 128, 2413 / 128, 2392 / 128
        root = value ** (1.0 / m2)
        light = 10_000.0 / _WHITE * (np.maximum(root - c1, 0.0) / (c2 - c3 * root)) ** (1.0 / m1)
    else:
        a, b, c = 0.17883277, 0.28466892, 0.55991073
        light = np.where(value <= 0.5, value**2 / 3.0, (np.exp((value - c) / a) + b) / 12.0)
    return light.astype(np.float32)


@functools.cache
def _build_srgb_table() -> NDArray[np.uint8]:
    """Build the table (65536,) of sRGB of linear light in 16 bits."""
    light = np.arange(65536) / 65535.0
    value = np.where(light <= 0.0031308, 12.92 * light, 1.055 * light ** (1.0 / 2.4) - 0.055)
    return np.rint(255.0 * value).astype(np.uint8)
