"""Features of photos lifted into Gaussians."""

from __future__ import annotations

import json
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import torch
from safetensors import SafetensorError, safe_open
from safetensors.torch import load_file
from torch import Tensor
from torch.nn import functional

from ..errors import FormatError, SceneError
from ..files import write_tensors
from ..progress import Progress, silent
from ..scene.camera import Camera, Scene
from ..splatting.gaussians import Gaussians
from ..splatting.rasterize import accumulate
from .encoders import DenseEncoder

FORMAT = "fruitlangs-features-1"


@dataclass(frozen=True, eq=False)
class Features:
    """What every Gaussian looks like to an encoder; any prompt can be asked of it, exactly, at any later time.

    vectors: (N, D) unit float32, zero where weight is 0; weights: (N,) float32, pixels drawn by the Gaussian (Σ α·T),
    summed over views; encoder_id: the identity of the encoder that made them.
    """

    vectors: Tensor
    weights: Tensor
    encoder_id: str


def lift_features(
    gaussians: Gaussians,
    cameras: Sequence[Camera],
    targets: Iterable[Tensor],
    *,
    encoder_id: str,
    progress: Progress = silent,
) -> Features:
    """Average each view's pixel features into the Gaussians that drew those pixels.

    targets: one (H, W, D) a view, at its camera's size. The weight of Gaussian i at pixel v is its blending weight
    α_i(v)·T_i(v), so f_i ∝ Σ w·F (Marrie et al. 2024, eq. 3), normalised. A pixel with a zero feature (masked out)
    counts for nothing. A Gaussian that no pixel saw has weight 0 and a zero feature.

    Raises:
        SceneError: a target's size differs from its camera's, or there are more or fewer targets than cameras.
    """
    sums: Tensor | None = None
    weights = torch.zeros(len(gaussians))
    given = iter(targets)
    for index, camera in enumerate(cameras):
        progress(index / len(cameras), f"lifting features of view {index + 1} of {len(cameras)}")
        target = next(given, None)
        if target is None:
            raise SceneError(f"features for {index} of {len(cameras)} views were given; give one a camera")
        if tuple(target.shape[:2]) != (camera.height, camera.width):
            raise SceneError(
                f"the features of view {index} are {target.shape[1]}×{target.shape[0]} pixels, its camera has "
                f"{camera.width}×{camera.height}; resize them"
            )
        usable = target.square().sum(-1, keepdim=True) > 0.0
        drawn = accumulate(gaussians, camera, torch.cat([target, usable.to(target.dtype)], dim=-1))
        sums = drawn.sums[:, :-1] if sums is None else sums + drawn.sums[:, :-1]
        weights += drawn.sums[:, -1]
    if sums is None:
        raise SceneError("there is no camera to lift features from; the scene needs at least one photo")
    if next(given, None) is not None:
        raise SceneError(f"features for more views than the {len(cameras)} cameras were given; give one a camera")
    progress(1.0, "features lifted")
    return Features(functional.normalize(sums, dim=-1), weights, encoder_id)


def encode_photos(scene: Scene, encoder: DenseEncoder) -> Iterator[Tensor]:
    """The targets of `lift_features`: each photo's features at its camera's size, zero where its mask says no."""
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


def save_features(path: Path, features: Features) -> None:
    """Write `features.safetensors` atomically; the encoder's identity is in its header.

    Raises:
        OutputError: the file cannot be written.
    """
    header = {"format": FORMAT, "encoder_id": features.encoder_id}
    write_tensors(path, {"vectors": features.vectors.contiguous(), "weights": features.weights.contiguous()}, header)


def load_features(path: Path) -> Features:
    """Read what `save_features` wrote.

    Raises:
        FormatError: the file is missing, damaged or something else.
    """
    try:
        with safe_open(path, framework="pt") as file:
            header = json.loads((file.metadata() or {})["fruitlangs"])
        tensors = load_file(path)
        if header["format"] != FORMAT:
            raise FormatError(f"{path} holds {header['format']}, not {FORMAT}; lift the features again")
        return Features(tensors["vectors"], tensors["weights"], header["encoder_id"])
    except (SafetensorError, OSError, KeyError, ValueError, TypeError) as error:
        raise FormatError(f"{path} holds no features ({str(error).splitlines()[0]}); lift them again") from error
