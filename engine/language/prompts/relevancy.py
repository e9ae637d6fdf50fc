"""The probability that each Gaussian matches the prompt (paper eq. 10 and 11)."""

from __future__ import annotations

import itertools
from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import networkx as nx
import torch
from torch import Tensor

from ...errors import EncoderError, VocabularyError
from ..encoders.encoder import Encoder, Question, TaughtQuestion, sees_fruit
from ..features.features import Features, blocks
from .levels import best_level
from .prior import weigh_for_scene

MIN_WEIGHT = 0.3
"""A Gaussian with fewer pixels than this, summed over all views, has probability 0."""
LEAST_PRIOR = 1e-3
"""The answer of a built-in word counts as at least this, and at most 1 − this, where a taught word refines it: nothing
is so certain that examples could not correct it."""
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
    "green apple" against "apple". P = P(any prompt) · (1 − P(any negative)); see `any_of`.

    Raises:
        EncoderError: the features were made by another encoder.
        VocabularyError: an unknown word, no prompt, or a prompt that a negative rules out altogether.
    """
    check_encoder(features, encoder)
    check_prompts(encoder, prompts, negatives)
    found = any_of(features, encoder, prompts)
    return found * (1.0 - any_of(features, encoder, negatives, sought=False)) if negatives else found


def any_of(features: Features, encoder: Encoder, words: Sequence[str], *, sought: bool = True) -> Tensor:
    """(N,) float32 probability that a Gaussian matches any of the words: the greatest sum of probabilities of words
    that exclude each other, at most 1.

    So a synonym, or a word within another one, adds nothing, kinds of fruit add, and the order does not matter. Each
    word uses the level of masks with the highest confidence (see `best_level`).
    """
    named = understand(encoder, words, sought=sought)
    if named.taught.any():
        check_taught(features, encoder, named.sizes)
    answers = answers_by_level(features, named) * (features.weights.T >= MIN_WEIGHT)[:, None]
    best = [answers[best_level(answers[:, place], features.weights.T), place] for place in range(answers.shape[1])]
    return union(best, named.texts, encoder)


def union(answers: Sequence[Tensor], words: Sequence[str], encoder: Encoder) -> Tensor:
    """(N,) float32 probability of any of P words, each with its answers (N,); see `any_of`."""
    greatest = torch.zeros(len(answers[0]), dtype=torch.float64)
    for together in exclusive_sets(words, encoder):
        greatest = greatest.maximum(
            sum((answers[place].double() for place in together), start=torch.zeros_like(greatest))
        )
    return greatest.clamp_max(1.0).float()


def exclusive_sets(words: Sequence[str], encoder: Encoder) -> list[tuple[int, ...]]:
    """Every largest set of words, by their places, that all exclude each other."""
    apart = nx.Graph()
    apart.add_nodes_from(range(len(words)))
    pairs = itertools.combinations(range(len(words)), 2)
    apart.add_edges_from((i, j) for i, j in pairs if encoder.separates(words[i], words[j]))
    return sorted(tuple(sorted(clique)) for clique in nx.find_cliques(apart))


def answers_by_level(features: Features, words: Words) -> Tensor:
    """(L, P, N) float32 probability of each word alone, at each level of masks."""
    answers = torch.empty(features.levels, len(words.questions), len(features))
    for level in range(features.levels):
        # The kinds of the scene are estimated from all Gaussians together.
        for rows in blocks(len(features), len(features) if len(words.kinds) else ROWS):
            evidence = features.evidence(rows) if words.taught.any() else None
            unit, weights = features.unit(level, rows), features.weights[rows, level]
            answers[level, :, rows] = scene_answers(unit, weights, words, evidence)
    return answers


@dataclass(frozen=True, eq=False)
class Words:
    """The encoder's representation of P words, each meaning once, in an order that does not depend on the user's.

    questions: of each word; kinds: the encoder's kinds of fruit, (K, D); named: (P, K) which kinds each word names;
    believed: (K,) which kinds are assumed to be in the scene; taught: (P,) which words a user taught.
    """

    texts: Sequence[str]
    questions: Sequence[Sequence[Question | TaughtQuestion]]
    kinds: Tensor
    named: Tensor
    believed: Tensor
    taught: Tensor

    @property
    def sizes(self) -> list[int]:
        """How many numbers of evidence each taught word takes."""
        return [
            len(each.word.weights) for asked in self.questions for each in asked if isinstance(each, TaughtQuestion)
        ]


def understand(encoder: Encoder, words: Sequence[str], *, sought: bool = True) -> Words:
    """Return the words as `encoder` represents them, computed once for any number of Gaussians.

    sought: they are prompts, so the kinds that they name are assumed to be there. Words for no kind of fruit, or for
    all of them, say nothing about that.

    Raises:
        VocabularyError: an unknown word.
    """
    meanings = {encoder.meaning(word): word for word in words}
    texts, kinds = [meanings[meaning] for meaning in sorted(meanings)], encoder.kinds()
    named = encoder.encode_text(texts) @ kinds.T > 0.0
    believed = named[telling_words(named)].any(0) if sought else torch.zeros(len(kinds), dtype=torch.bool)
    questions = [encoder.questions(word) for word in texts]
    taught = torch.tensor([any(isinstance(each, TaughtQuestion) for each in asked) for asked in questions])
    return Words(texts, questions, kinds, named, believed, taught)


def telling_words(named: Tensor) -> Tensor:
    """(P,) whether each word names some kinds of fruit, and not all; named: (P, K)."""
    return named.any(1) & ~named.all(1)


def scene_answers(vectors: Tensor, weights: Tensor, words: Words, evidence: Tensor | None = None) -> Tensor:
    """(P, N) probability of each word for all unit features (N, D) of a scene, with (N,) pixels. evidence: (N, F), for
    taught words.

    Kinds of fruit are weighted by their share of the scene and by what is believed to be there (see `prior`).
    """
    telling = telling_words(words.named)
    weighed = weigh_for_scene(vectors, weights, words.kinds, words.believed) if telling.any() else vectors
    return torch.stack(answers_of(vectors, weighed, words, evidence))


def answers_of(vectors: Tensor, weighed: Tensor, words: Words, evidence: Tensor | None = None) -> list[Tensor]:
    """The probability of each word for unit features (N, D), given also with their kinds weighted by the scene, and
    with the evidence (N, F) for taught words."""
    pairs = zip(words.questions, telling_words(words.named), strict=True)
    return [answer(weighed if tells else vectors, questions, evidence) for questions, tells in pairs]


def answer(vectors: Tensor, questions: Sequence[Question | TaughtQuestion], evidence: Tensor | None = None) -> Tensor:
    """(…, D) unit features → (…) product of the questions' calibrated margins. evidence: (…, F), for taught words."""
    probability = torch.ones(vectors.shape[:-1])
    for question in questions:
        if isinstance(question, TaughtQuestion):
            assert evidence is not None
            prior = torch.logit(answer(vectors, question.prior), eps=LEAST_PRIOR) if question.prior else 0.0
            probability = probability * torch.sigmoid(question.word.logit(evidence) + prior)
        else:
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


def check_taught(features: Features, encoder: Encoder, sizes: Iterable[int] = ()) -> None:
    """Refuse features that taught words cannot query. sizes: how many numbers each word takes.

    Raises:
        EncoderError: an earlier version made them, without an embedding, or a word takes other evidence.
    """
    if sees_fruit(encoder) and features.embedding is None:
        raise EncoderError(
            "These features are from an earlier version and know built-in words only. Count again from the photos to "
            "use taught words"
        )
    size = features.evidence(slice(0, 1)).shape[1]
    for wanted in sizes:
        if wanted != size:
            raise EncoderError(
                f"The taught word takes {wanted} numbers and these features have {size}. Teach it again in a result of "
                "these settings"
            )


def taught_words(encoder: Encoder, phrases: Sequence[str]) -> dict[str, dict[str, str]]:
    """{"words": {name: identity}} of the taught words in phrases, for the provenance; empty without any.

    Raises:
        VocabularyError: an unknown word.
        FormatError, EncoderError: a taught word cannot be used.
    """
    asked = (question for phrase in phrases for question in encoder.questions(phrase))
    words = {each.word.name: each.word.identity for each in asked if isinstance(each, TaughtQuestion)}
    return {"words": words} if words else {}


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
