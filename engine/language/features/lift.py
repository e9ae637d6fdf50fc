"""Features of photos, lifted into Gaussians."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import replace

import torch
from torch import Tensor
from torch.nn import functional

from ...compiled.heap import release_freed
from ...progress import Progress, silent
from ...scene.camera import Camera, Photo, Scene
from ...scene.photos.resample import shrink_mask
from ...splatting.gaussians import Gaussians
from ...splatting.rendering.rasterize import accumulate
from ..encoders.encoder import DenseEncoder, FruitEncoder, sees_fruit
from .features import Features
from .pairing import pair_views
from .photo_features import PhotoFeatures, PhotoFeaturesRecorder, Wanted

MOST_VALUES = 40_000_000
"""Numbers of a photo's features that Gaussians gather at once: of 1600×1200 pixels there are 140 million."""


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
    views = pair_views(cameras, targets, lambda target: target.shape[:2], "features", smaller=True)
    for index, camera, target in views:
        progress(index / len(cameras), f"Lifting features of view {index + 1} of {len(cameras)}")
        length = target.shape[-1] - embedded
        drawn = _gather(gaussians, camera, target, length)
        del target  # before the next photo is encoded
        drawn *= cameras[index].width * cameras[index].height / (camera.width * camera.height)
        sums = drawn[:, :-1] if sums is None else sums.add_(drawn[:, :-1])
        weights += drawn[:, -1]
        said += drawn[:, :length].norm(dim=-1)
    assert sums is not None  # `pair_views` refuses a scene without cameras
    progress(1.0, "features lifted")
    # Σ |c|·cos(c, Σ c) = |Σ c|, so one pass measures how far the contributions c of the views agree.
    totals = sums[:, :length]
    agreement = totals.norm(dim=-1) / said.clamp_min(1e-12)
    vectors = functional.normalize(totals, dim=-1)
    means = (sums[:, length:] / weights.clamp_min(1e-12)[:, None]).half() if embedded else None
    return Features(vectors[:, None], weights[:, None], agreement[:, None], encoder_id, embedding=means)


def _gather(gaussians: Gaussians, camera: Camera, target: Tensor, length: int) -> Tensor:
    """Return (N, C + 1) what each Gaussian gathers of a target (H, W, C), and of 1 where a pixel counts: not where its
    feature, the first `length` channels, is zero. Some channels at a time, so that large photos need little memory."""
    usable = target[..., :length].any(-1)
    whole, channels = bool(usable.all()), target.shape[-1] + 1
    step = max(MOST_VALUES // usable.numel(), 1)
    sums = []
    for start in range(0, channels, step):
        stop = min(start + step, channels)
        part = torch.empty(*usable.shape, stop - start)
        own = target[..., start:stop]
        part[..., : own.shape[-1]] = own
        if stop == channels:
            part[..., -1] = usable
        if not whole:
            part[~usable] = 0.0
        sums.append(accumulate(gaussians, camera, part).sums)
    return torch.cat(sums, dim=1)


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
        release_freed()
        yield _encode(photo, encoder, own, recorder, embedded)


def _encode(
    photo: Photo, encoder: DenseEncoder, scales: Sequence[float], recorder: PhotoFeaturesRecorder | None, embedded: bool
) -> Tensor:
    """Compute the target of one photo, see `encode_photos`."""
    pixels, view = photo.pixels(), None
    if (recorder is not None or embedded) and sees_fruit(encoder):
        view = encoder.encode_fruit(pixels, scales)
        features = torch.cat([view.features, view.embedding], dim=-1) if embedded else view.features
    else:
        features = encoder.encode_dense(pixels, scales)
    if (mask := photo.mask()) is not None:
        usable = torch.from_numpy(shrink_mask(mask, features.shape[1], features.shape[0]))
        features = features * usable[..., None]
    if recorder is not None and view is not None:
        recorder.keep(replace(view, features=features[..., : view.features.shape[-1]]), pixels, scales)
    return features.contiguous()


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
    return recorder.collect()
