"""Measured pixels: features and labels."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.nn import functional

from ...engine.language.encoders.embedded import EmbeddedEncoder
from ...engine.language.prompts.relevancy import answer, scene_answers, understand
from ...engine.language.vocabulary import CONCEPTS, FRUITS
from .pictures import NOT_FRUIT, Labels, Picture, find_inside

FloatArray = NDArray[np.float64]

STEP = 4
"""Step between measured pixels, across and down."""


@dataclass(frozen=True, eq=False)
class Sample:
    """Every STEP-th pixel of a picture: features (M, D) in half precision, labels (M,), colours (M, 3) in [0, 1];
    boxed: (M,) inside a box; missed: (M,) on fruit that has no box (`pictures.UNBOXED`).
    """

    features: Tensor
    labels: Labels
    colours: FloatArray
    boxed: NDArray[np.bool_]
    missed: NDArray[np.bool_]
    source: str

    @property
    def fruit(self) -> NDArray[np.bool_]:
        """(M,) certainly fruit."""
        return self.labels < len(FRUITS)

    @property
    def known(self) -> NDArray[np.bool_]:
        """(M,) certainly fruit or certainly not."""
        return (self.labels < len(CONCEPTS)) | (self.labels == NOT_FRUIT)

    def select(self, chosen: NDArray[np.bool_]) -> Sample:
        """Select some of these pixels."""
        return Sample(
            self.features[torch.from_numpy(chosen)],
            self.labels[chosen],
            self.colours[chosen],
            self.boxed[chosen],
            self.missed[chosen],
            self.source,
        )


def sample(encoder: EmbeddedEncoder, pictures: Sequence[Picture]) -> list[Sample]:
    """Encode each picture once; everything but the pasted words is measured on these pixels."""
    return [_sample_picture(encoder, picture) for picture in pictures]


def _sample_picture(encoder: EmbeddedEncoder, picture: Picture) -> Sample:
    shape = picture.labels.shape
    boxed, missed = np.zeros(shape, bool), np.zeros(shape, bool)
    for box in picture.boxes:
        boxed |= find_inside(box, 1.0, shape, ellipse=False)
    for box in picture.unboxed:
        missed |= find_inside(box, 1.0, shape, ellipse=False)
    every = np.s_[::STEP, ::STEP]
    return Sample(
        interpolate(encoder.encode_dense(picture.pixels), shape, STEP).flatten(0, 1).half(),
        picture.labels[every].ravel(),
        picture.pixels[every].reshape(-1, 3) / 255.0,
        boxed[every].ravel(),
        missed[every].ravel(),
        picture.source,
    )


def interpolate(outputs: Tensor, shape: Sequence[int], step: int = 1) -> Tensor:
    """Return the outputs (h, w, D) of the encoder for a photo of this height and width, interpolated at every `step`-th
    row and column of the photo."""
    rows, columns = ((torch.arange(0, length, step) + 0.5) * 2.0 / length - 1.0 for length in shape)
    places = torch.stack(torch.meshgrid(columns, rows, indexing="xy"), dim=-1)
    image = outputs.permute(2, 0, 1)[None]
    found = functional.grid_sample(image, places[None], padding_mode="border", align_corners=False)
    return found[0].permute(1, 2, 0)


def answers(encoder: EmbeddedEncoder, pixels: Sample, word: str) -> FloatArray:
    """(M,) the probability of a word, without the prior of the scene."""
    return answer(pixels.features.float(), encoder.questions(word)).double().numpy()


def answers_in_scene(encoder: EmbeddedEncoder, scene: Sample, word: str) -> FloatArray:
    """(M,) the probability of a word, with kinds of fruit weighted by their share of the scene as in use."""
    weights = torch.full((len(scene.features),), float(STEP * STEP))
    return scene_answers(scene.features.float(), weights, understand(encoder, [word]))[0].double().numpy()


def join_by_scene(samples: Sequence[Sample]) -> list[Sample]:
    """Join the pixels of each scene."""
    scenes = []
    for source in sorted({each.source for each in samples}):
        mine = [each for each in samples if each.source == source]
        scenes.append(
            Sample(
                torch.cat([each.features for each in mine]),
                np.concatenate([each.labels for each in mine]),
                np.concatenate([each.colours for each in mine]),
                np.concatenate([each.boxed for each in mine]),
                np.concatenate([each.missed for each in mine]),
                source,
            )
        )
    return scenes
