"""Counts the fruit that prompts name, and looks for fruit of other kinds if the prompts miss much of what looks like
fruit."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

from torch import Tensor

from ..config import CountConfig
from ..errors import CountingError
from ..language.encoders.encoder import Encoder, KindEncoder, names_kinds, sees_fruit
from ..language.features.features import Features
from ..language.features.photo_features import PhotoFeatures
from ..language.prompts.colour_choice import ColourChoice, split_by_colour
from ..language.prompts.likely_kinds import UNKNOWN_KIND, likely_kinds
from ..language.prompts.photo_probability import PhotoMap, photo_probabilities, prepare_photos
from ..language.prompts.selection import select
from ..progress import Progress, part, silent
from ..scene.camera import Scene
from ..splatting.gaussians import Gaussians
from .accounts.ids import NO_FRUIT, KnownFruit
from .accounts.other_kinds import AnyKind, add_other_kinds
from .accounts.zero import UNKNOWN, Quality
from .count import count_fruit
from .fruit import FruitCount

SURPLUS = 1.25
"""Ratio of the pixels that match fruit of any kind to those that match the prompt, from which other kinds are
counted."""


@dataclass(frozen=True, eq=False)
class Searched:
    """A reconstructed scene in which prompts are counted; photos: features of the photos' pixels, None without."""

    scene: Scene
    gaussians: Gaussians
    features: Features
    photos: PhotoFeatures | None
    encoder: Encoder
    config: CountConfig
    quality: Quality = UNKNOWN


@dataclass(frozen=True, eq=False)
class _Match:
    """What fruit are searched in: the probability of each Gaussian (N,) and the maps of the photos; and which colours
    are counted, where these two are of the fruit of any colour."""

    probability: Tensor
    photos: Sequence[PhotoMap] | None = None
    choice: ColourChoice | None = None
    notices: Sequence[str] = ()


def count_prompts(
    searched: Searched,
    prompts: Sequence[str],
    negatives: Sequence[str],
    probability: Tensor,
    *,
    known: KnownFruit = NO_FRUIT,
    progress: Progress = silent,
) -> FruitCount:
    """Count the fruit that match any of `prompts` and none of `negatives`.

    probability: (N,) that each Gaussian does, see `select`; known: see `count_fruit`. If fruit of other kinds are at
    least as many as these, notices say so and the intervals admit them, see `add_other_kinds`.

    Raises:
        CountingError, ConfigError, FormatError: see `count_fruit`.
        VocabularyError: an unknown word.
    """
    match = _match(searched, prompts, negatives, probability, part(progress, 0.0, 0.3))
    counted = _count(searched, prompts, match, known, part(progress, 0.3, 0.8))
    if not names_kinds(searched.encoder):
        return counted
    # Trees are found by their fruit. Where none was found, there may be fewer fruit of other kinds than trees.
    again = searched if counted.trees else replace(searched, config=replace(searched.config, trees=0))
    label = _label(prompts, searched.encoder)
    try:
        found = _count_any_kind(again, searched.encoder, prompts, negatives, match, part(progress, 0.8, 1.0))
    except CountingError as error:  # the count of the prompt stands
        return replace(counted, notices=[*counted.notices, f"fruit of other kinds could not be counted: {error}"])
    return counted if found is None else add_other_kinds(counted, found, label)


def _match(
    searched: Searched, prompts: Sequence[str], negatives: Sequence[str], probability: Tensor, progress: Progress
) -> _Match:
    """What the prompts' fruit are searched in; probability: (N,) that each Gaussian matches the prompts."""
    config, encoder = searched.config, searched.encoder
    if config.method != "voting" or config.select == "dual":
        return _Match(probability)
    split = split_by_colour(encoder, prompts, negatives)
    wanted = (prompts, negatives) if split is None else (split.prompts, split.negatives)
    photos, notices = _photos_for(searched, wanted, progress)
    maps = None if photos is None else photo_probabilities(photos, searched.features, encoder, *wanted)
    if split is None:
        return _Match(probability, maps, notices=notices)
    uncoloured = select(searched.features, encoder, *wanted, config, searched.gaussians.means)
    return _Match(uncoloured, maps, ColourChoice.of(split, searched.gaussians, photos), notices)


def _photos_for(
    searched: Searched, wanted: tuple[Sequence[str], Sequence[str]], progress: Progress
) -> tuple[PhotoFeatures | None, list[str]]:
    """What the pixels of the photos say about the prompts and negatives, None if there are no photos, and notices."""
    if searched.photos is None or not sees_fruit(searched.encoder):
        return searched.photos, []
    photos = prepare_photos(
        searched.photos, searched.scene, searched.features, searched.encoder, *wanted, progress=progress
    )
    if photos is None:
        missing = "a taught word is searched in the photos, and they are missing: fruit that Gaussians lose were not"
        return None, [f"{missing} counted"]
    return photos, []


def _count(
    searched: Searched, prompts: Sequence[str], match: _Match, known: KnownFruit, progress: Progress
) -> FruitCount:
    counted = count_fruit(
        searched.gaussians,
        match.probability,
        searched.scene.cameras,
        searched.config,
        label=_label(prompts, searched.encoder),
        known=known,
        up=searched.scene.up,
        quality=searched.quality,
        photos=match.photos,
        choice=match.choice,
        progress=progress,
    )
    return replace(counted, notices=[*match.notices, *counted.notices])


def _count_any_kind(
    searched: Searched,
    encoder: KindEncoder,
    prompts: Sequence[str],
    negatives: Sequence[str],
    match: _Match,
    progress: Progress,
) -> AnyKind | None:
    """Count the fruit of any kind; None if the prompts name no kinds, or most of what looks like fruit matches them.

    Raises:
        CountingError: it cannot be counted.
    """
    general = [encoder.of_any_kind(prompt) for prompt in prompts]
    words = list(dict.fromkeys(filter(None, general)))
    if None in general:
        return None
    config, features, means = searched.config, searched.features, searched.gaussians.means
    wider = _match(searched, words, negatives, select(features, encoder, words, negatives, config, means), silent)
    if not _surpasses(wider, match, features.weights[:, 0], config.threshold):
        return None
    counted = _count(searched, words, wider, NO_FRUIT, progress)
    kinds = likely_kinds(features, [fruit.members for fruit in counted.fruits], encoder.kinds())
    names = ["" if kind == UNKNOWN_KIND else encoder.kind_words[kind] for kind in kinds.tolist()]
    return AnyKind(counted, names, " or ".join(words))


def _surpasses(wider: _Match, match: _Match, weights: Tensor, threshold: float) -> bool:
    """Whether far more surface, or more pixels of the photos, match `wider` than `match`; weights: (N,) pixels of each
    Gaussian."""
    ours, all_kinds = (float(weights[each.probability >= threshold].sum()) for each in (match, wider))
    if all_kinds > SURPLUS * ours:
        return True
    shown, shown_all = (
        sum(int((each.probability >= threshold).sum()) for each in either.photos or ()) for either in (match, wider)
    )
    return shown_all > SURPLUS * shown


def _label(prompts: Sequence[str], encoder: Encoder) -> str:
    """The label of the counted fruit: "Apples" → "apple"; several prompts are joined."""
    return " or ".join(dict.fromkeys(encoder.label(prompt) for prompt in prompts))
