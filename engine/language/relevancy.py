"""How likely each Gaussian is what the prompt says (paper eq. 10 and 11)."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from ..errors import EncoderError, VocabularyError
from .encoders import Encoder, Question
from .lift import Features
from .prior import in_scene

MIN_WEIGHT = 0.3
"""A Gaussian that drew less than this many pixels, summed over all views, has no say: its probability is 0."""


def relevancy(
    features: Features,
    encoder: Encoder,
    prompts: Sequence[str],
    negatives: Sequence[str] = (),
) -> Tensor:
    """(N,) float32 probability that a Gaussian is any of `prompts` and none of `negatives`.

    Each prompt is answered by the encoder's questions (see `Question`), which put it against every other word that
    makes sense for it; so `negatives` are needed only for what the vocabulary does not already set against the prompt,
    for example "green apple" against "apple". P = (1 − Π(1 − P(prompt))) · Π(1 − P(negative)), where kinds of fruit
    have been weighed by how much of the scene's fruit they are (see `prior`).

    Raises:
        EncoderError: the features were made by another encoder.
        VocabularyError: an unknown word, no prompt, or a prompt that a negative rules out altogether.
    """
    if features.encoder_id != encoder.identity:
        raise EncoderError(
            f"the features were made by {features.encoder_id}, the words come from {encoder.identity}; lift the "
            "features again with this encoder"
        )
    check_prompts(encoder, prompts, negatives)
    vectors = in_scene(features.vectors, features.weights, encoder.kinds())
    missed = torch.ones(len(features.weights))
    for prompt in prompts:
        missed *= 1.0 - answer(vectors, encoder.questions(prompt))
    found = 1.0 - missed
    for negative in negatives:
        found *= 1.0 - answer(vectors, encoder.questions(negative))
    return torch.where(features.weights >= MIN_WEIGHT, found, torch.zeros(()))


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


def check_prompts(encoder: Encoder, prompts: Sequence[str], negatives: Sequence[str] = ()) -> None:
    """Refuse what `relevancy` could not answer, before anything is computed for it.

    Raises:
        VocabularyError: an unknown word, no prompt, or a prompt that a negative rules out altogether.
    """
    if not prompts:
        raise VocabularyError("no prompt was given; name what to count, for example --prompt apple")
    encoder.encode_text([*prompts, *negatives])
    for prompt in prompts:
        for negative in negatives:
            if encoder.excludes(prompt, negative):
                raise VocabularyError(
                    f"the prompt '{prompt}' is ruled out by the negative '{negative}'; leave one of them out"
                )
