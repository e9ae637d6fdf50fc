"""The fruit of the generator: shape, size, colours, growth, and leaves."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from .srgb import to_linear

FloatArray = NDArray[np.float64]


@dataclass(frozen=True, kw_only=True)
class Variant:
    """Colours of a variety as sRGB hex strings; a blush lies over a gradient from the stalk to the far end."""

    name: str
    top: str
    middle: str
    bottom: str
    blush: str
    blush_strength: tuple[float, float]
    """Least and greatest share of blush at its centre, drawn per fruit."""
    blush_width: float = 1.0
    """Half width of the blush as a fraction of the half turn; above 1 it wraps around."""
    stripes: float = 0.0
    """Strength of stripes from the stalk to the far end."""


@dataclass(frozen=True, kw_only=True)
class Species:
    """A kind of fruit and its tree. Lengths in metres."""

    name: str
    profile: tuple[tuple[float, float], ...]
    """(height, radius) from the stalk's end to the far end, any scale; a Catmull–Rom curve runs through them."""
    diameter: float
    """Mean diameter: of the sphere of equal volume."""
    spread: float
    """Standard deviation of the diameter ÷ its mean."""
    stalk: tuple[float, float]
    """Shortest and longest stalk."""
    clump_sizes: tuple[float, ...]
    """Probabilities of clumps of 1, 2, 3 … fruit."""
    variants: tuple[Variant, ...]
    leaf_length: float
    leaf_width: float
    leaf_tip: float = 0.55
    """Where the leaf is widest, from 0 at its base to 1 at its tip."""
    leaf_colors: tuple[str, str] = ("#4d6b25", "#7d9440")
    """Darkest and lightest leaf."""
    tree_height: float = 2.1
    roughness: float = 0.38
    """Roughness of the surface."""
    fuzz: float = 0.0
    """Strength of the sheen of a hairy surface."""
    lenticels: float = 0.0
    """Strength of the pale dots of the surface."""
    pores: float = 0.0
    """Strength of the dimples of a peel."""
    bloom: float = 0.0
    """Greatest share of the pale waxy film, which is wiped off in places."""


_APPLE = (
    (0.36, 0.0), (0.38, 0.05), (0.45, 0.15), (0.475, 0.26), (0.42, 0.39), (0.27, 0.485), (0.06, 0.515),
    (-0.15, 0.475), (-0.31, 0.37), (-0.41, 0.25), (-0.43, 0.15), (-0.40, 0.07), (-0.37, 0.0),
)  # fmt: skip
_PEAR = (
    (0.70, 0.0), (0.71, 0.05), (0.67, 0.12), (0.52, 0.185), (0.34, 0.25), (0.14, 0.34), (-0.08, 0.435),
    (-0.28, 0.475), (-0.44, 0.42), (-0.55, 0.28), (-0.58, 0.14), (-0.54, 0.06), (-0.52, 0.0),
)  # fmt: skip
_CHERRY = (
    (0.38, 0.0), (0.40, 0.06), (0.46, 0.18), (0.44, 0.33), (0.30, 0.46), (0.06, 0.52), (-0.20, 0.465),
    (-0.38, 0.32), (-0.455, 0.15), (-0.465, 0.0),
)  # fmt: skip
_PLUM = (
    (0.58, 0.0), (0.59, 0.07), (0.56, 0.18), (0.45, 0.32), (0.24, 0.435), (0.0, 0.47), (-0.24, 0.43), (-0.44, 0.31),
    (-0.56, 0.15), (-0.60, 0.0),
)  # fmt: skip
_LEMON = (
    (0.68, 0.0), (0.68, 0.05), (0.63, 0.10), (0.53, 0.20), (0.38, 0.335), (0.18, 0.43), (-0.02, 0.46), (-0.22, 0.42),
    (-0.42, 0.30), (-0.56, 0.16), (-0.66, 0.09), (-0.74, 0.05), (-0.76, 0.0),
)  # fmt: skip
_ORANGE = (
    (0.445, 0.0), (0.45, 0.08), (0.45, 0.17), (0.385, 0.33), (0.22, 0.455), (0.0, 0.505), (-0.22, 0.46), (-0.39, 0.33),
    (-0.465, 0.17), (-0.475, 0.06), (-0.47, 0.0),
)  # fmt: skip
_PEACH = (
    (0.39, 0.0), (0.41, 0.06), (0.465, 0.16), (0.44, 0.31), (0.29, 0.455), (0.04, 0.51), (-0.22, 0.455), (-0.40, 0.30),
    (-0.49, 0.13), (-0.535, 0.03), (-0.54, 0.0),
)  # fmt: skip
_MANGO = (
    (0.64, 0.0), (0.645, 0.09), (0.60, 0.23), (0.46, 0.36), (0.22, 0.435), (-0.05, 0.435), (-0.30, 0.37), (-0.52, 0.25),
    (-0.66, 0.12), (-0.71, 0.04), (-0.72, 0.0),
)  # fmt: skip

_FIG = (
    (0.68, 0.0), (0.68, 0.05), (0.62, 0.085), (0.50, 0.13), (0.34, 0.24), (0.14, 0.37), (-0.08, 0.465), (-0.26, 0.45),
    (-0.40, 0.34), (-0.47, 0.19), (-0.48, 0.07), (-0.475, 0.0),
)  # fmt: skip
_EGGPLANT = (
    (2.0, 0.0), (2.0, 0.16), (1.90, 0.33), (1.6, 0.45), (1.0, 0.50), (0.2, 0.54), (-0.6, 0.56), (-1.3, 0.53),
    (-1.75, 0.42), (-1.95, 0.24), (-2.0, 0.08), (-2.0, 0.0),
)  # fmt: skip

SPECIES: dict[str, Species] = {
    each.name: each
    for each in (
        Species(
            name="apple", profile=_APPLE, diameter=0.078, spread=0.08, stalk=(0.012, 0.030),
            clump_sizes=(0.45, 0.27, 0.16, 0.08, 0.04),
            variants=(
                Variant(name="red", top="#a83420", middle="#bb1d22", bottom="#c4443a", blush="#8f0d1c",
                        blush_strength=(0.35, 0.95), blush_width=0.9, stripes=0.25),
                Variant(name="green-red", top="#a9ab44", middle="#c6b85a", bottom="#cbc066", blush="#cc2b30",
                        blush_strength=(0.6, 0.98), blush_width=0.62, stripes=0.5),
                Variant(name="green", top="#7fa02f", middle="#93b53c", bottom="#a3bd52", blush="#bfa65a",
                        blush_strength=(0.0, 0.45), blush_width=0.5),
            ),
            leaf_length=0.078, leaf_width=0.046, roughness=0.34, lenticels=0.15,
        ),
        Species(
            name="pear", profile=_PEAR, diameter=0.074, spread=0.08, stalk=(0.020, 0.038),
            clump_sizes=(0.55, 0.27, 0.13, 0.05),
            variants=(
                Variant(name="green", top="#8b9946", middle="#9bab52", bottom="#a3ac5a", blush="#a8824e",
                        blush_strength=(0.1, 0.55), blush_width=0.7),
                Variant(name="russet", top="#9c8048", middle="#ad9152", bottom="#a28550", blush="#b46a44",
                        blush_strength=(0.1, 0.6), blush_width=0.7),
                Variant(name="yellow", top="#b3a545", middle="#c9b955", bottom="#bfae52", blush="#c0603a",
                        blush_strength=(0.1, 0.75), blush_width=0.5),
            ),
            leaf_length=0.070, leaf_width=0.045, leaf_tip=0.48, leaf_colors=("#3f6329", "#6f8f42"),
            roughness=0.45, lenticels=0.4,
        ),
        Species(
            name="cherry", profile=_CHERRY, diameter=0.023, spread=0.07, stalk=(0.022, 0.042),
            clump_sizes=(0.20, 0.30, 0.25, 0.15, 0.10),
            variants=(
                Variant(name="red", top="#9c1420", middle="#a80f1f", bottom="#b01824", blush="#5e0612",
                        blush_strength=(0.1, 0.8), blush_width=1.0),
                Variant(name="green", top="#84a437", middle="#9db84d", bottom="#a9bf58", blush="#c9b45a",
                        blush_strength=(0.0, 0.6), blush_width=0.7),
                Variant(name="yellow-red", top="#d2a743", middle="#dcb24e", bottom="#d9ae55", blush="#c22a22",
                        blush_strength=(0.4, 0.95), blush_width=0.7),
            ),
            leaf_length=0.095, leaf_width=0.045, leaf_tip=0.58, leaf_colors=("#36601f", "#6b9438"),
            tree_height=2.4, roughness=0.2,
        ),
        Species(
            name="plum", profile=_PLUM, diameter=0.042, spread=0.08, stalk=(0.010, 0.022),
            clump_sizes=(0.35, 0.30, 0.20, 0.10, 0.05),
            variants=(
                Variant(name="blue", top="#3b3157", middle="#453a68", bottom="#4a3a63", blush="#6c2c4c",
                        blush_strength=(0.0, 0.8), blush_width=0.8),
                Variant(name="red", top="#8a2038", middle="#96243a", bottom="#8e2e40", blush="#521026",
                        blush_strength=(0.2, 0.8), blush_width=0.8),
                Variant(name="yellow", top="#c2a53c", middle="#d3b244", bottom="#cfae4c", blush="#c9682f",
                        blush_strength=(0.0, 0.7), blush_width=0.5),
            ),
            leaf_length=0.070, leaf_width=0.040, leaf_tip=0.58, leaf_colors=("#41632a", "#71903f"),
            tree_height=2.2, roughness=0.42, bloom=0.4,
        ),
        Species(
            name="lemon", profile=_LEMON, diameter=0.062, spread=0.09, stalk=(0.010, 0.022),
            clump_sizes=(0.50, 0.28, 0.16, 0.06),
            variants=(
                Variant(name="yellow", top="#dcb91e", middle="#ecc927", bottom="#e6c12a", blush="#b8b52c",
                        blush_strength=(0.0, 0.5), blush_width=0.8),
                Variant(name="green-yellow", top="#8fa32a", middle="#b3b52f", bottom="#bdb635", blush="#e2c42c",
                        blush_strength=(0.2, 0.9), blush_width=0.8),
            ),
            leaf_length=0.090, leaf_width=0.046, leaf_tip=0.5, leaf_colors=("#2f5a22", "#6c943a"),
            tree_height=1.9, roughness=0.4, pores=0.5,
        ),
        Species(
            name="orange", profile=_ORANGE, diameter=0.078, spread=0.07, stalk=(0.008, 0.018),
            clump_sizes=(0.50, 0.28, 0.15, 0.07),
            variants=(
                Variant(name="orange", top="#d96f12", middle="#ea7d16", bottom="#e8821c", blush="#f09a2c",
                        blush_strength=(0.0, 0.6), blush_width=0.8),
                Variant(name="green-orange", top="#8c962c", middle="#c28f27", bottom="#d58b22", blush="#e68419",
                        blush_strength=(0.3, 0.95), blush_width=0.8),
            ),
            leaf_length=0.088, leaf_width=0.044, leaf_tip=0.5, leaf_colors=("#274f1e", "#5b8734"),
            roughness=0.4, pores=0.5,
        ),
        Species(
            name="peach", profile=_PEACH, diameter=0.072, spread=0.08, stalk=(0.010, 0.018),
            clump_sizes=(0.50, 0.30, 0.15, 0.05),
            variants=(
                Variant(name="red-yellow", top="#dd9a45", middle="#e0a04c", bottom="#dfa65a", blush="#b32a2b",
                        blush_strength=(0.5, 0.98), blush_width=0.75),
                Variant(name="yellow", top="#d9a043", middle="#e3ac4c", bottom="#e4b45c", blush="#d9713a",
                        blush_strength=(0.1, 0.7), blush_width=0.6),
            ),
            leaf_length=0.120, leaf_width=0.034, leaf_tip=0.5, leaf_colors=("#42692a", "#7a9c42"),
            tree_height=2.15, roughness=0.75, fuzz=0.25,
        ),
        Species(
            name="mango", profile=_MANGO, diameter=0.096, spread=0.10, stalk=(0.03, 0.09),
            clump_sizes=(0.50, 0.30, 0.15, 0.05),
            variants=(
                Variant(name="green-red", top="#a63a35", middle="#8d8f3a", bottom="#8a9a3e", blush="#a8302e",
                        blush_strength=(0.2, 0.9), blush_width=0.6),
                Variant(name="green", top="#5f7f33", middle="#6f8f3b", bottom="#7d9a45", blush="#a3a34a",
                        blush_strength=(0.0, 0.5), blush_width=0.7),
                Variant(name="yellow", top="#d39a2c", middle="#dfae36", bottom="#dcb33f", blush="#cf6a31",
                        blush_strength=(0.1, 0.8), blush_width=0.6),
            ),
            leaf_length=0.150, leaf_width=0.038, leaf_tip=0.5, leaf_colors=("#2b5522", "#5d8836"),
            tree_height=2.7, roughness=0.42, lenticels=0.3,
        ),
        Species(
            name="fig", profile=_FIG, diameter=0.050, spread=0.09, stalk=(0.006, 0.014),
            clump_sizes=(0.60, 0.28, 0.12),
            variants=(
                Variant(name="striped", top="#9aa562", middle="#c9be8f", bottom="#b8a096", blush="#5a3068",
                        blush_strength=(0.85, 0.99), blush_width=1.0, stripes=1.0),
                Variant(name="green", top="#7d9440", middle="#93a551", bottom="#9fae5f", blush="#6a4a5c",
                        blush_strength=(0.0, 0.4), blush_width=0.6, stripes=0.6),
            ),
            leaf_length=0.110, leaf_width=0.075, leaf_tip=0.5, leaf_colors=("#3a6128", "#71913f"),
            tree_height=2.2, roughness=0.55, lenticels=0.35, bloom=0.15,
        ),
        Species(
            name="eggplant", profile=_EGGPLANT, diameter=0.068, spread=0.08, stalk=(0.015, 0.030),
            clump_sizes=(0.80, 0.20),
            variants=(
                Variant(name="purple", top="#3c1d4a", middle="#34173f", bottom="#2f1538", blush="#6d3a80",
                        blush_strength=(0.0, 0.5), blush_width=0.6),
                Variant(name="white", top="#d8d6c2", middle="#e6e2d4", bottom="#e2dccb", blush="#a87fb8",
                        blush_strength=(0.0, 0.5), blush_width=0.6, stripes=0.4),
            ),
            leaf_length=0.140, leaf_width=0.090, leaf_tip=0.45, leaf_colors=("#4b6b38", "#7f9a58"),
            tree_height=2.1, roughness=0.22,
        ),
    )
}  # fmt: skip
UNNAMED = ("fig", "eggplant")
"""Species that the encoder has no word for and never learns from: for words that are taught."""


def linear_rgb(hex_color: str) -> FloatArray:
    """(3,) scene-linear colour of an sRGB hex string."""
    return to_linear(np.array([int(hex_color[i : i + 2], 16) for i in (1, 3, 5)]) / 255.0)
