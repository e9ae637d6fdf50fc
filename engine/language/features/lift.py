"""Features of photos, lifted into Gaussians."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence

import torch
from torch import Tensor
from torch.nn import functional

from ...progress import Progress, silent
from ...scene.camera import Camera, Scene
from ...splatting.gaussians import Gaussians
from ...splatting.rendering.rasterize import accumulate
from ..encoders.encoder import DenseEncoder
from .features import Features
from .pairing import paired


def lift_features(
    gaussians: Gaussians,
    cameras: Sequence[Camera],
    targets: Iterable[Tensor],
    *,
    encoder_id: str,
    progress: Progress = silent,
) -> Features:
    """Average the pixel features of each view into the Gaussians that rendered the pixels.

    targets: one (H, W, D) per view, at its camera's size. The weight of Gaussian i at pixel v is its blending weight
    α_i(v)·T_i(v), so f_i ∝ Σ w·F (Marrie et al. 2024, eq. 3), normalised. A pixel with a zero feature (masked out) does
    not count. A Gaussian that no pixel shows has weight 0 and a zero feature. There is one level.

    Raises:
        SceneError: a target's size differs from its camera's, or there are more or fewer targets than cameras.
    """
    sums: Tensor | None = None
    weights, said = torch.zeros(len(gaussians)), torch.zeros(len(gaussians))
    for index, (camera, target) in enumerate(paired(cameras, targets, lambda target: target.shape[:2], "features")):
        progress(index / len(cameras), f"Lifting features of view {index + 1} of {len(cameras)}")
        usable = target.square().sum(-1, keepdim=True) > 0.0
        drawn = accumulate(gaussians, camera, torch.cat([target, usable.to(target.dtype)], dim=-1))
        sums = drawn.sums[:, :-1] if sums is None else sums + drawn.sums[:, :-1]
        weights += drawn.sums[:, -1]
        said += drawn.sums[:, :-1].norm(dim=-1)
    assert sums is not None  # `paired` refuses a scene without cameras
    progress(1.0, "features lifted")
    # Σ |c|·cos(c, Σ c) = |Σ c|, so one pass measures how far the contributions c of the views agree.
    agreement = sums.norm(dim=-1) / said.clamp_min(1e-12)
    vectors = functional.normalize(sums, dim=-1)
    return Features(vectors[:, None], weights[:, None], agreement[:, None], encoder_id)


def encode_photos(scene: Scene, encoder: DenseEncoder) -> Iterator[Tensor]:
    """The targets of `lift_features`: the features of each photo at its camera's size, zero where its mask excludes
    it."""
    for camera, photo in zip(scene.cameras, scene.images, strict=True):
        yield at_size(encoder.encode_dense(photo.pixels()), camera.height, camera.width, photo.mask())


def at_size(features: Tensor, height: int, width: int, mask: object = None) -> Tensor:
    """(H', W', D) → (height, width, D), bilinearly, zero where the (height, width) bool mask is False."""
    if tuple(features.shape[:2]) != (height, width):
        channels = features.permute(2, 0, 1)[None]
        channels = functional.interpolate(channels, (height, width), mode="bilinear", antialias=True)
        features = functional.normalize(channels[0].permute(1, 2, 0), dim=-1)
    if mask is not None:
        features = features * torch.as_tensor(mask)[..., None]
    return features.contiguous()
