"""The difference between the rasteriser's values and gradients and those of its float64 reference implementation."""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor

from ...scene.camera import Camera
from ..gaussians import PARAMETERS, Gaussians
from .rasterize import Rendering, render
from .reference import render_reference

FEATURES = 3
"""Extra channels that are rendered and differentiated as well."""


def compare_with_reference(gaussians: Gaussians, camera: Camera, *, seed: int = 0) -> dict[str, float]:
    """Largest difference over the largest reference value: of each output, and of each gradient of a random weighting.

    A pixel whose α lies within float32 rounding of 1/255 is drawn by one and not by the other; a scene that has one
    shows an error near 1/255 there. Scenes are small: the memory of the reference grows with Gaussians × pixels.
    """
    generator = torch.Generator().manual_seed(seed)

    def random(*shape: int) -> Tensor:
        return torch.randn(*shape, generator=generator, dtype=torch.float64)

    n, size = len(gaussians), (camera.height, camera.width)
    inputs = [getattr(gaussians, name).detach().double() for name in PARAMETERS]
    inputs += [random(n, FEATURES), random(3), torch.zeros(n, 2, dtype=torch.float64)]
    weights = [random(*size, 3), random(*size), random(*size), random(*size, FEATURES)]
    ours = _run(render, inputs, weights, camera, gaussians.antialiased, torch.float32)
    reference = _run(render_reference, inputs, weights, camera, gaussians.antialiased, torch.float64)
    return {
        name: float((ours[name].double() - reference[name]).abs().max() / reference[name].abs().max().clamp_min(1e-30))
        for name in reference
    }


def _run(
    draw: Callable[..., Rendering],
    inputs: list[Tensor],
    weights: list[Tensor],
    camera: Camera,
    antialiased: bool,
    dtype: torch.dtype,
) -> dict[str, Tensor]:
    """Outputs and gradients by name."""
    leaves = [value.to(dtype).clone().requires_grad_() for value in inputs]
    features, background, offsets = leaves[len(PARAMETERS) :]
    gaussians = Gaussians(*leaves[: len(PARAMETERS)], antialiased=antialiased)
    rendering = draw(gaussians, camera, features=features, background=background, screen_offsets=offsets)
    assert rendering.features is not None
    outputs = {
        "color": rendering.color,
        "alpha": rendering.alpha,
        "depth": rendering.weighted_depth,
        "features": rendering.features,
    }
    total = torch.zeros((), dtype=dtype)
    for output, weight in zip(outputs.values(), weights, strict=True):
        total = total + (output * weight.to(dtype)).sum()
    total.backward()
    names = [*PARAMETERS, "features", "background", "offsets"]
    found = {name: output.detach() for name, output in outputs.items()}
    for name, leaf in zip(names, leaves, strict=True):
        assert leaf.grad is not None
        found[f"d {name}"] = leaf.grad
    return found
