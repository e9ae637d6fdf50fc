"""What the encoder of whole photos says about every pixel that may be fruit, kept for later prompts."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from PIL import Image
from torch import Tensor
from torch.nn import functional
from torch.nn.utils.rnn import pad_sequence

from ...errors import FormatError
from ...storage.files import read_tensors, write_tensors
from ..encoders.encoder import Encoder, FruitView, sees_fruit
from ..encoders.seen import MOST

FORMAT, EARLIER = "fruitlangs-photo-features-4", "fruitlangs-photo-features-3"
"""EARLIER: without scales, of versions whose encoder saw photos of any fruit at 960 pixels a side."""
LEAST_FRUIT = 0.15
"""Probability of any fruit below which a pixel is not kept."""
STEPS, OFFSET_STEPS = 255.0, 80.0
"""Numbers, and offsets, are kept in steps of one of this."""
TENSORS = ("shapes", "counts", "places", "values", "offsets", "colours", "scales")
"""Names of the tensors in the file."""


@dataclass(frozen=True, eq=False)
class PhotoFeatures:
    """The features of the pixels of V photos that may be fruit, one photo after the other.

    shapes: (V, 2) int64 height and width of what was kept of each photo; counts: (V,) int64 kept pixels of each;
    places: (n,) int32 row · width + column of each; values: (n, D) uint8, unit features in steps of 1 / STEPS;
    offsets: (n, 2) int8, where on its fruit each pixel lies, see `OffsetNetwork`, in steps of 1 / OFFSET_STEPS;
    colours: (n, 3) uint8 sRGB; scales: (V, S) float32 sizes at which the encoder saw each photo, relative to it, the
    largest first, 0 after the last and where they are not known; encoder_id: `fruit_identity` of the encoder;
    embedding: (n, E) float16 for taught words, not stored, None without.
    """

    shapes: Tensor
    counts: Tensor
    places: Tensor
    values: Tensor
    offsets: Tensor
    colours: Tensor
    scales: Tensor
    encoder_id: str
    embedding: Tensor | None = None

    def __len__(self) -> int:
        return len(self.counts)

    def are_of(self, encoder: Encoder) -> bool:
        """Whether the weights of this encoder made them."""
        return sees_fruit(encoder) and self.encoder_id == encoder.fruit_identity

    @property
    def seen_at(self) -> list[tuple[float, ...]]:
        """The scales of each photo, none where they are not known."""
        return [tuple(scale for scale in row if scale > 0.0) for row in self.scales.tolist()]

    def photos(self) -> Iterator[tuple[tuple[int, int], Tensor, Tensor, Tensor, Tensor]]:
        """Of each photo its height and width, the places (k,) of its kept pixels, their unit features (k, D), their
        offsets (k, 2), and their embedding (k, E), E = 0 without one."""
        embedding = torch.zeros(len(self.places), 0) if self.embedding is None else self.embedding
        for shape, places, values, offsets, embedded in self._parts(self.values, self.offsets, embedding):
            unit = functional.normalize(values.float(), dim=-1)
            yield shape, places.long(), unit, offsets.float() / OFFSET_STEPS, embedded.float()

    def iterate_colours(self) -> Iterator[tuple[tuple[int, int], Tensor, Tensor]]:
        """Yield of each photo its height and width, the places (k,) of its kept pixels and their sRGB (k, 3) in [0,
        1]."""
        for shape, places, colours in self._parts(self.colours):
            yield shape, places.long(), colours.float() / STEPS

    def _parts(self, *kept: Tensor) -> Iterator[tuple[Any, ...]]:
        """Of each photo its shape, the places of its pixels and its rows of each tensor in `kept`."""
        counts = self.counts.tolist()
        shapes = ((height, width) for height, width in self.shapes.tolist())
        return zip(shapes, *(each.split(counts) for each in (self.places, *kept)), strict=True)


Wanted = Callable[[Tensor, Tensor], Tensor]
"""Features (k, D) and embedding (k, E) of pixels → (k,) probability that they are asked for."""


class PhotoFeaturesRecorder:
    """Keeps what `PhotoFeatures` needs of one photo after the other."""

    def __init__(self, kinds: Tensor, encoder_id: str, wanted: Wanted | None = None) -> None:
        """kinds: (K, D) orthonormal text vectors of the kinds of fruit; encoder_id: `fruit_identity` of the encoder;
        wanted: which pixels are kept, with their embedding; without it those that may be fruit of any kind."""
        self._kinds, self._encoder_id, self._wanted = kinds, encoder_id, wanted
        self._embedding: list[Tensor] = []
        self._shapes: list[tuple[int, int]] = []
        self._places: list[Tensor] = []
        self._values: list[Tensor] = []
        self._offsets: list[Tensor] = []
        self._colours: list[Tensor] = []
        self._scales: list[Tensor] = []

    def collect(self) -> PhotoFeatures:
        """Collect what was kept of all photos that were passed on."""
        width = self._kinds.shape[1]
        return PhotoFeatures(
            torch.tensor(self._shapes, dtype=torch.int64).reshape(-1, 2),
            torch.tensor([len(each) for each in self._places], dtype=torch.int64),
            torch.cat([*self._places, torch.zeros(0, dtype=torch.int32)]),
            torch.cat([*self._values, torch.zeros(0, width, dtype=torch.uint8)]),
            torch.cat([*self._offsets, torch.zeros(0, 2, dtype=torch.int8)]),
            torch.cat([*self._colours, torch.zeros(0, 3, dtype=torch.uint8)]),
            pad_sequence(self._scales, batch_first=True) if self._scales else torch.zeros(0, 1),
            self._encoder_id,
            torch.cat(self._embedding) if self._embedding else None,
        )

    def keep(self, view: FruitView, pixels: NDArray[np.uint8], scales: Sequence[float]) -> None:
        """What the encoder sees in the next photo, the photo in sRGB (h, w, 3) of any size, and the scales."""
        photo, offsets, embedding = view.features, view.offsets, view.embedding
        if self._wanted is None:
            fruit = fruit_share(photo, self._kinds).reshape(-1)
        else:
            embedding = embedding.reshape(-1, embedding.shape[-1])
            fruit = self._wanted(functional.normalize(photo.reshape(-1, photo.shape[-1]), dim=-1), embedding)
        shown = photo.any(-1).reshape(-1)  # not outside a mask
        places = (shown & (fruit >= LEAST_FRUIT)).nonzero()[:, 0]
        if self._wanted is not None:
            self._embedding.append(embedding[places].half())
        values = functional.normalize(photo[places // photo.shape[1], places % photo.shape[1]], dim=-1)
        self._shapes.append((photo.shape[0], photo.shape[1]))
        self._scales.append(torch.tensor(list(scales), dtype=torch.float32))
        self._places.append(places.int())
        self._values.append((values.clamp(0.0, 1.0) * STEPS).round().to(torch.uint8))
        small = Image.fromarray(pixels).resize((photo.shape[1], photo.shape[0]), Image.Resampling.BOX)
        self._colours.append(torch.from_numpy(np.array(small)).reshape(-1, 3)[places])
        steps = (offsets.reshape(-1, 2)[places] * OFFSET_STEPS).round()
        self._offsets.append(steps.clamp(-127, 127).to(torch.int8))


def fruit_share(vectors: Tensor, kinds: Tensor) -> Tensor:
    """(…) share of each feature (…, D) that is fruit of any of the kinds (K, D): 2 Σ cos², as in `prior`."""
    return 2.0 * (vectors @ kinds.T).square().sum(-1)


def save_photo_features(path: Path, kept: PhotoFeatures) -> None:
    """Write the file atomically.

    Raises:
        OutputError: it cannot be written.
    """
    tensors = {name: getattr(kept, name).contiguous() for name in TENSORS}
    write_tensors(path, tensors, {"format": FORMAT, "encoder_id": kept.encoder_id})


def load_photo_features(path: Path) -> PhotoFeatures:
    """Read the file that `save_photo_features` wrote.

    Raises:
        FormatError: it is missing, damaged, of an earlier version or something else.
    """
    try:
        tensors, header = read_tensors(path)
        if header["format"] == EARLIER:
            tensors["scales"] = torch.zeros(len(tensors["counts"]), 1)
        elif header["format"] != FORMAT:
            raise ValueError(f"it holds {header['format']}")
        kept = PhotoFeatures(**tensors, encoder_id=str(header["encoder_id"]))
        pixels = int(kept.counts.sum())
        fits = kept.shapes.shape == (len(kept), 2) and len(kept.places) == len(kept.values) == pixels
        fits &= kept.offsets.shape == (pixels, 2) and kept.offsets.dtype == torch.int8
        fits &= kept.colours.shape == (pixels, 3) and kept.colours.dtype == torch.uint8
        fits &= kept.scales.ndim == 2 and len(kept.scales) == len(kept) and kept.scales.dtype == torch.float32
        fits &= bool(((kept.scales >= 0.0) & (kept.scales <= MOST)).all())
        if not fits or kept.values.dtype != torch.uint8 or kept.values.ndim != 2:
            raise ValueError("its tensors do not fit")
        ends = kept.shapes.prod(1).repeat_interleave(kept.counts)
        if bool(((kept.places < 0) | (kept.places >= ends)).any()):
            raise ValueError("a pixel lies outside its photo")
        return kept
    except (KeyError, TypeError, ValueError, RuntimeError) as error:
        reason = str(error).splitlines()[0]
        raise FormatError(f"{path} holds no features of photos ({reason}). Count again from the photos") from error
