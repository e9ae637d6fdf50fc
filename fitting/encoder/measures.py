"""All measurements in the model card: on photos, renders and plain pictures that were not used for training."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass

import numpy as np
from numpy.typing import NDArray

from ...engine.language.encoders.embedded import EmbeddedEncoder
from ...engine.language.vocabulary import CONCEPTS, GENERAL
from .calibration import Fit
from .confusable import Distinction, find_colour_distinctions, find_distinctions
from .photo_scores import PhotoScore, score_pasted_words, score_photos
from .pictures import Picture
from .reliability import Judged, judge_probabilities
from .render_scores import Condition, RenderScore, score_conditions, score_renders
from .samples import Sample, answers


@dataclass(frozen=True)
class Measures:
    """By fruit: `photos`, `pasted_word`, `renders` (and of "fruit"). `words`: each against its most confused word;
    colours are measured on named colours. `reliability` of P("fruit") on renders and photos; `conditions`: what makes
    fruit hard to recognise.
    """

    photos: dict[str, PhotoScore]
    pasted_word: dict[str, float]
    renders: dict[str, RenderScore]
    words: dict[str, Distinction]
    colours: dict[str, Distinction]
    reliability: dict[str, Judged]
    conditions: dict[str, Condition]

    def document(self) -> dict[str, object]:
        return asdict(self)


@dataclass(frozen=True, eq=False)
class Unseen:
    """Pictures not used for training, with the measured pixels of each."""

    photos: Sequence[Picture]
    renders: Sequence[Picture]
    photo_samples: Sequence[Sample]
    render_samples: Sequence[Sample]
    plain_samples: Sequence[Sample]


@dataclass(frozen=True, eq=False)
class Half:
    """The measured pixels of some photos and of the renders of some scenes."""

    photo_samples: Sequence[Sample]
    render_samples: Sequence[Sample]


def split_halves(unseen: Unseen) -> tuple[Half, Half]:
    """Split into halves for calibration and for its evaluation: every other photo, every other scene."""
    scenes = sorted({each.source for each in unseen.renders})
    return _select_half(unseen, set(scenes[::2]), 0), _select_half(unseen, set(scenes[1::2]), 1)


def _select_half(unseen: Unseen, scenes: set[str], first: int) -> Half:
    return Half(unseen.photo_samples[first::2], [each for each in unseen.render_samples if each.source in scenes])


def measure(encoder: EmbeddedEncoder, unseen: Unseen, tested: Half, fit: Fit) -> Measures:
    """fit: the calibration of single pixels, which `encoder` uses; tested: the pixels that its reliability is measured
    on."""
    reliable = {
        "renders": _measure_reliability(encoder, tested.render_samples, fit),
        "photos": _measure_reliability(encoder, tested.photo_samples, fit),
    }
    return Measures(
        photos=score_photos(encoder, unseen.photo_samples),
        pasted_word=score_pasted_words(encoder, unseen.photos),
        renders=score_renders(encoder, unseen.render_samples),
        words=_measure_words(encoder, [*unseen.photo_samples, *unseen.render_samples, *unseen.plain_samples]),
        colours=find_colour_distinctions(),
        reliability={name: found for name, found in reliable.items() if found is not None},
        conditions=score_conditions(encoder, unseen.renders, unseen.render_samples),
    )


def _measure_reliability(encoder: EmbeddedEncoder, samples: Sequence[Sample], fit: Fit) -> Judged | None:
    if not samples:
        return None
    known = [each.select(each.known & (each.fruit | ~each.missed)) for each in samples]
    guess = np.concatenate([answers(encoder, each, "fruit") for each in known])
    return judge_probabilities(guess, np.concatenate([each.fruit for each in known]), fit.prior)


def _measure_words(encoder: EmbeddedEncoder, samples: Sequence[Sample]) -> dict[str, Distinction]:
    known = [each.select(each.labels < len(CONCEPTS)) for each in samples]
    truth: NDArray[np.str_] = np.array(CONCEPTS)[np.concatenate([each.labels for each in known])]
    asked = {word: np.concatenate([answers(encoder, each, word) for each in known]) for word in (*CONCEPTS, *GENERAL)}
    return find_distinctions(asked, truth, general=GENERAL)
