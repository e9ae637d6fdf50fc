"""Features of photos, lifted into Gaussians."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import replace

import torch
from torch import Tensor
from torch.nn import functional

from ...progress import Progress, silent
from ...scene.camera import Camera, Scene
from ...scene.photos.resample import shrink_mask
from ...splatting.gaussians import Gaussians
from ...splatting.rendering.rasterize import accumulate
from ..encoders.encoder import DenseEncoder, FruitEncoder, sees_fruit
from .features import Features
from .pairing import paired
from .photo_features import PhotoFeatures, PhotoFeaturesRecorder, Wanted


def lift_features(
    gaussians: Gaussians,
    cameras: Sequence[Camera],
    targets: Iterable[Tensor],
    *,
    encoder_id: str,
    embedded: int = 0,
    progress: Progress = silent,
) -> Features:
    """Average the pixel features of each view into the Gaussians that rendered the pixels.

    targets: one (H, W, D) per view, of its camera's size or evenly scaled down, as the encoder gave it. The weight of
    Gaussian i at pixel v is its blending weight α_i(v)·T_i(v), so f_i ∝ Σ w·F (Marrie et al. 2024, eq. 3), normalised.
    A pixel with a zero feature (masked out) does not count; one of a smaller target counts as the pixels of the camera
    that it covers. A Gaussian that no pixel shows has weight 0 and a zero feature. There is one level. embedded: how
    many channels, the last of each target, are an embedding instead, whose mean is taken.

    Raises:
        SceneError: a target's size differs from its camera's, or there are more or fewer targets than cameras.
    """
    sums: Tensor | None = None
    weights, said = torch.zeros(len(gaussians)), torch.zeros(len(gaussians))
    views = paired(cameras, targets, lambda target: target.shape[:2], "features", smaller=True)
    for index, (camera, target) in enumerate(views):
        progress(index / len(cameras), f"Lifting features of view {index + 1} of {len(cameras)}")
        length = target.shape[-1] - embedded
        drawn = accumulate(gaussians, camera, _with_count(target, length)).sums
        drawn *= cameras[index].width * cameras[index].height / (camera.width * camera.height)
        sums = drawn[:, :-1] if sums is None else sums.add_(drawn[:, :-1])
        weights += drawn[:, -1]
        said += drawn[:, :length].norm(dim=-1)
    assert sums is not None  # `paired` refuses a scene without cameras
    progress(1.0, "features lifted")
    # Σ |c|·cos(c, Σ c) = |Σ c|, so one pass measures how far the contributions c of the views agree.
    totals = sums[:, :length]
    agreement = totals.norm(dim=-1) / said.clamp_min(1e-12)
    vectors = functional.normalize(totals, dim=-1)
    means = (sums[:, length:] / weights.clamp_min(1e-12)[:, None]).half() if embedded else None
    return Features(vectors[:, None], weights[:, None], agreement[:, None], encoder_id, embedding=means)


def _with_count(target: Tensor, length: int) -> Tensor:
    """(H, W, C + 1) a target (H, W, C) with 1 where a pixel counts, and zeros where its feature, the first `length`
    channels, is zero."""
    usable = target[..., :length].any(-1)
    drawn = torch.empty(*target.shape[:2], target.shape[2] + 1)
    drawn[..., :-1], drawn[..., -1] = target, usable
    if not bool(usable.all()):
        drawn[~usable] = 0.0
    return drawn


def encode_photos(
    scene: Scene,
    encoder: DenseEncoder,
    scales: Sequence[Sequence[float]],
    recorder: PhotoFeaturesRecorder | None = None,
    *,
    embedded: bool = False,
) -> Iterator[Tensor]:
    """The targets of `lift_features`: the features of each photo as the encoder gives them, zero where its mask
    excludes it.

    scales: at which each photo is processed, see `DenseEncoder.scales_of`; recorder: keeps what an encoder that
    distinguishes single fruit says about every pixel; embedded: with the embedding of such an encoder.
    """
    for photo, own in zip(scene.images, scales, strict=True):
        pixels, view = photo.pixels(), None
        if (recorder is not None or embedded) and sees_fruit(encoder):
            view = encoder.encode_fruit(pixels, own)
            features = torch.cat([view.features, view.embedding], dim=-1) if embedded else view.features
        else:
            features = encoder.encode_dense(pixels, own)
        if (mask := photo.mask()) is not None:
            usable = torch.from_numpy(shrink_mask(mask, features.shape[1], features.shape[0]))
            features = features * usable[..., None]
        if recorder is not None and view is not None:
            recorder.keep(replace(view, features=features[..., : view.features.shape[-1]]), pixels, own)
        yield features.contiguous()


def record_photos(
    scene: Scene,
    encoder: FruitEncoder,
    scales: Sequence[Sequence[float]],
    wanted: Wanted | None = None,
    *,
    progress: Progress = silent,
) -> PhotoFeatures:
    """What the encoder says about the pixels of all photos of a scene. scales: as of `encode_photos`; wanted: as of
    `PhotoFeaturesRecorder`.

    Raises:
        SceneError: a photo cannot be read.
    """
    recorder = PhotoFeaturesRecorder(encoder.kinds(), encoder.fruit_identity, wanted)
    for number, _ in enumerate(encode_photos(scene, encoder, scales, recorder)):
        progress((number + 1) / len(scene.images), f"Encoding photo {number + 1} of {len(scene.images)}")
    return recorder.kept()
