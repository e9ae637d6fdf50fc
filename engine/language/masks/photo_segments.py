"""The masks of every photo with one feature each, and their cache on disk."""

from __future__ import annotations

import hashlib
import math
import zlib
from collections.abc import Iterator
from itertools import islice
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.nn import functional

from ...errors import SceneError
from ...progress import Progress, part, silent
from ...scene.camera import Scene
from ...storage.files import read_tensors, write_tensors
from ...storage.keys import stage_key
from ..encoders.encoder import CropEncoder
from .crops import crop_masks
from .segmenter import Segmenter
from .segments import SegmentedView, number_masks

FORMAT = "fruitlangs-segments-1"
FINDING = 0.5
"""Share of a view's progress for finding its masks; the rest is for encoding them."""
BATCH = 32
"""Crops in memory at once; progress is reported, and a cancel noticed, between two batches."""


def segment_views(
    scene: Scene, segmenter: Segmenter, encoder: CropEncoder, cache: Path, progress: Progress = silent
) -> Iterator[SegmentedView]:
    """Yield the masks of each view with their features, one view at a time, in the scene's order.

    Pixels that a photo's mask excludes are -1. A view without masks is all -1 with vectors (0, D). Views are cached
    below `cache` under the content of their photo and the identities of segmenter and encoder, in half precision, as
    soon as they are computed. A view has the same bits when it is computed as when it is read.

    Raises:
        SceneError: a photo cannot be read, or is not of its camera's size.
        OutputError: `cache` cannot be written.
        Cancelled: `progress` asked for it.
    """
    key = stage_key(("scene", "language", "splatting", "compiled"), segmenter.identity, encoder.identity)
    folder = cache / f"segments-{key}"
    for index, (camera, photo) in enumerate(zip(scene.cameras, scene.images, strict=True)):
        mine = part(progress, index / len(scene.cameras), (index + 1) / len(scene.cameras))
        place = f"view {index + 1} of {len(scene.cameras)}"
        mine(0.0, f"masks of {place}")
        image, usable = photo.pixels(), photo.mask()
        if image.shape[:2] != (camera.height, camera.width):
            raise SceneError(
                f"The photo {photo.name} has {image.shape[1]}×{image.shape[0]} pixels, its camera "
                f"{camera.width}×{camera.height}. Resize it"
            )
        path = folder / f"{_content(image, usable)}.safetensors"
        view = _read(path, encoder.dimension)
        if view is None:

            def report(share: float, doing: str, mine: Progress = mine, place: str = place) -> None:
                mine(share, f"{place}: {doing}")

            view = _segment(image, usable, segmenter, encoder, report)
            _write(path, view)
        yield view
    progress(1.0, "masks of all views are available")


def _segment(
    image: NDArray[np.uint8],
    usable: NDArray[np.bool_] | None,
    segmenter: Segmenter,
    encoder: CropEncoder,
    progress: Progress,
) -> SegmentedView:
    """Return the same as `_read` after `_write`: vectors rounded to half precision."""
    segments = segmenter.segment(image, progress=part(progress, 0.0, FINDING))
    if usable is not None:
        segments = number_masks(np.where(usable, segments.labels, np.int32(-1)))
    crops, vectors = crop_masks(image, segments), [torch.zeros(0, encoder.dimension)]
    while batch := list(islice(crops, BATCH)):
        seen = sum(map(len, vectors))
        progress(FINDING + (1.0 - FINDING) * seen / segments.count, f"Encoding mask {seen + 1} of {segments.count}")
        vectors.append(encoder.encode_crops(batch))
    return SegmentedView(segments.labels, _unit(torch.cat(vectors).half()))


def _content(image: NDArray[np.uint8], usable: NDArray[np.bool_] | None) -> str:
    """A name for the content of a photo and its usable pixels."""
    digest = hashlib.sha256(f"{image.shape}{usable is None}".encode())
    digest.update(np.ascontiguousarray(image).data)
    if usable is not None:
        digest.update(np.packbits(usable).data)
    return digest.hexdigest()[:32]


def _write(path: Path, view: SegmentedView) -> None:
    """Labels are compressed: 24 megapixels at three levels take 288 MB uncompressed."""
    packed = np.frombuffer(zlib.compress(np.ascontiguousarray(view.labels, "<i4").data, 1), np.uint8)
    tensors = {"labels": torch.from_numpy(packed.copy()), "vectors": view.vectors.half()}
    write_tensors(path, tensors, {"format": FORMAT, "shape": view.labels.shape})


def _read(path: Path, dimension: int) -> SegmentedView | None:
    """Read a view written by `_write`; None if it is missing or damaged, so that it is computed again."""
    try:
        tensors, header = read_tensors(path)
        packed, vectors = tensors["labels"].numpy(), tensors["vectors"]
        size = 4 * math.prod(header["shape"])
        labels = np.frombuffer(zlib.decompressobj().decompress(packed.tobytes(), size), "<i4").astype(np.int32)
        labels = labels.reshape(header["shape"])
    except (KeyError, TypeError, ValueError, zlib.error):
        return None
    whole = header["format"] == FORMAT and vectors.shape[1:] == (dimension,) and labels.max(initial=-1) < len(vectors)
    return SegmentedView(labels, _unit(vectors)) if whole else None


def _unit(vectors: Tensor) -> Tensor:
    return functional.normalize(vectors.float(), dim=-1)
