"""The probability that each Gaussian matches the prompt (paper eq. 10 and 11)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from ...errors import EncoderError, VocabularyError
from ..encoders.encoder import Encoder, Question
from ..features.features import Features, blocks
from .levels import best_level
from .prior import in_scene

MIN_WEIGHT = 0.3
"""A Gaussian with fewer pixels than this, summed over all views, has probability 0."""
ROWS = 16_384
"""Gaussians whose features are decoded or converted to single precision at a time."""


def relevancy(
    features: Features,
    encoder: Encoder,
    prompts: Sequence[str],
    negatives: Sequence[str] = (),
) -> Tensor:
    """(N,) float32 probability that a Gaussian matches any of `prompts` and none of `negatives`.

    Each prompt is answered by the encoder's questions (see `Question`), which compare it with every other relevant
    word, so `negatives` are needed only for words that the vocabulary does not compare with the prompt, for example
    "green apple" against "apple". P = (1 − Π(1 − P(prompt))) · Π(1 − P(negative)), after kinds of fruit were weighted
    by their share of the scene and by the prompt (see `prior`). Each word uses the level of masks with the highest
    confidence (see `best_level`).

    Raises:
        EncoderError: the features were made by another encoder.
        VocabularyError: an unknown word, no prompt, or a prompt that a negative rules out altogether.
    """
    check_encoder(features, encoder)
    check_prompts(encoder, prompts, negatives)
    answers = answers_by_level(features, encoder, prompts, negatives)
    answers = answers * (features.weights.T >= MIN_WEIGHT)[:, None]
    missed = torch.ones(len(features))
    for place in range(len(prompts)):
        missed *= 1.0 - answers[best_level(answers[:, place], features.weights.T), place]
    found = 1.0 - missed
    for place in range(len(prompts), answers.shape[1]):
        found *= 1.0 - answers[best_level(answers[:, place], features.weights.T), place]
    return found


def answers_by_level(
    features: Features, encoder: Encoder, prompts: Sequence[str], negatives: Sequence[str] = ()
) -> Tensor:
    """(L, P, N) float32 probability of each word alone, prompts first, at each level of masks."""
    words = understood(encoder, prompts, negatives)
    answers = torch.empty(features.levels, len(words.questions), len(features))
    for level in range(features.levels):
        # The kinds of the scene are estimated from all Gaussians together.
        for rows in blocks(len(features), len(features) if len(words.kinds) else ROWS):
            answers[level, :, rows] = scene_answers(features.unit(level, rows), features.weights[rows, level], words)
    return answers


@dataclass(frozen=True, eq=False)
class Words:
    """The encoder's representation of P words. questions: of each word; kinds: the encoder's kinds of fruit, (K, D);
    named: (P, K) which kinds each word names; sought: (P,) whether it is a prompt and not a negative.
    """

    questions: Sequence[Sequence[Question]]
    kinds: Tensor
    named: Tensor
    sought: Sequence[bool]


def understood(encoder: Encoder, prompts: Sequence[str], negatives: Sequence[str] = ()) -> Words:
    """The words as `encoder` represents them, prompts first, computed once for any number of Gaussians.

    Raises:
        VocabularyError: an unknown word.
    """
    kinds, words = encoder.kinds(), [*prompts, *negatives]
    named = encoder.encode_text(words) @ kinds.T > 0.0
    sought = [place < len(prompts) for place in range(len(words))]
    return Words([encoder.questions(word) for word in words], kinds, named, sought)


def scene_answers(vectors: Tensor, weights: Tensor, words: Words) -> Tensor:
    """(P, N) probability of each word for all unit features (N, D) of a scene, with (N,) pixels.

    The prior assumes that prompts are there. Words for no kind of fruit, or for all of them, do not change the prior.
    """
    answers = torch.empty(len(words.questions), len(vectors))
    alike: dict[tuple[bool, ...], list[int]] = {}
    for place, (mine, sought) in enumerate(zip(words.named, words.sought, strict=True)):
        if not mine.any() or mine.all():
            answers[place] = answer(vectors, words.questions[place])
        else:
            alike.setdefault(tuple((mine & sought).tolist()), []).append(place)
    for believed, places in alike.items():
        weighed = in_scene(vectors, weights, words.kinds, torch.tensor(believed))
        for place in places:
            answers[place] = answer(weighed, words.questions[place])
    return answers


def answer(vectors: Tensor, questions: Sequence[Question]) -> Tensor:
    """(…, D) unit features → (…) product of the questions' calibrated margins."""
    probability = torch.ones(vectors.shape[:-1])
    for question in questions:
        probability = probability * torch.sigmoid(margin(vectors, question) / question.temperature - question.bias)
    return probability


def margin(vectors: Tensor, question: Question) -> Tensor:
    """(…, D) unit features → (…) uncalibrated margin in the encoder's score."""
    positive, negative = vectors @ question.positives.T, vectors @ question.negatives.T
    if question.score == "posterior":
        positive, negative = (2.0 * cosine.clamp_min(1e-6).log() for cosine in (positive, negative))
        return positive.logsumexp(-1) - negative.logsumexp(-1)
    return positive.amax(-1) - negative.amax(-1)


def check_encoder(features: Features, encoder: Encoder) -> None:
    """Refuse features that do not belong to the encoder.

    Raises:
        EncoderError: the features were made by another encoder.
    """
    if features.encoder_id != encoder.identity:
        raise EncoderError(
            f"The features were made by {features.encoder_id}, the words come from {encoder.identity}. Lift the "
            "features again with this encoder"
        )


def check_prompts(encoder: Encoder, prompts: Sequence[str], negatives: Sequence[str] = ()) -> None:
    """Refuse prompts that `relevancy` cannot answer, before anything is computed.

    Raises:
        VocabularyError: an unknown word, no prompt, or a prompt that a negative rules out altogether.
    """
    if not prompts:
        raise VocabularyError("No prompt is given. Add what to count, for example --prompt apple")
    encoder.encode_text([*prompts, *negatives])
    for prompt in prompts:
        for negative in negatives:
            if encoder.excludes(prompt, negative):
                raise VocabularyError(
                    f"The prompt '{prompt}' is excluded by the negative '{negative}'. Leave one of them out"
                )
