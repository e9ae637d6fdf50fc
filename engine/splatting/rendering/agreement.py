"""The difference between values and gradients of the CPU, or of a graphics card, and those of the float64 reference."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import torch
from torch import Tensor

from ...scene.camera import Camera
from ..gaussians import PARAMETERS, Gaussians
from ..gpu.drawing import Canvas, view_of
from ..kernels.tile import TRANSMITTANCE
from .rasterize import Rendering, render
from .reference import render_reference
from .render import DrawRules, arrays_of

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


def compare_card_with_reference(
    canvas: Canvas, gaussians: Gaussians, camera: Camera, *, seed: int = 0
) -> dict[str, float]:
    """Largest difference over the largest reference value: of colour, depth and alpha, and of each gradient of a random
    weighting of them. Scenes are small, as for `rendering.agreement.compare_with_reference`.

    Raises:
        GpuError: the card failed.
    """
    pixels = np.random.default_rng(seed).standard_normal((5, camera.height, camera.width)).astype(np.float32)
    rules = DrawRules(sh_degree=gaussians.sh_degree, antialiased=gaussians.antialiased)
    view = view_of(camera, rules, len(gaussians))
    view["with_depth"] = view["with_mean_gradients"] = 1
    ours = canvas.compute(arrays_of(gaussians), view, pixel_gradients=pixels)
    leaves = {name: getattr(gaussians, name).detach().double().requires_grad_() for name in PARAMETERS}
    offsets = torch.zeros(len(gaussians), 2, dtype=torch.float64, requires_grad=True)
    exact = Gaussians(**leaves, antialiased=gaussians.antialiased)
    theirs = render_reference(exact, camera, screen_offsets=offsets)
    weights = torch.from_numpy(pixels).double()
    total = (theirs.color * weights[:3].permute(1, 2, 0)).sum() + (theirs.weighted_depth * weights[3]).sum()
    (total + (theirs.alpha * weights[4]).sum()).backward()  # type: ignore[no-untyped-call]
    pairs = {
        "color": (ours.planes[:3].transpose(1, 2, 0), theirs.color),
        "depth": (ours.planes[3], theirs.weighted_depth),
        "alpha": (1.0 - ours.planes[TRANSMITTANCE], theirs.alpha),
        **{f"d {name}": (ours.gradients[name], leaf.grad) for name, leaf in leaves.items()},
        "d offsets": (ours.gradients["offsets"], offsets.grad),
    }
    found = {}
    for name, (own, other) in pairs.items():
        assert other is not None
        expected = other.detach().numpy()
        found[name] = float(np.abs(own - expected).max() / max(np.abs(expected).max(), 1e-30))
    return found


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
