"""Which kind of fruit a fruit looks like."""

from __future__ import annotations

import numpy as np
import torch

from fruitlangs.engine.language.features.features import Features
from fruitlangs.engine.language.prompts.likely_kinds import UNKNOWN_KIND, likely_kinds

KINDS = torch.eye(4)[:2]


def features(weights: list[float], vectors: list[list[float]]) -> Features:
    unit = torch.nn.functional.normalize(torch.tensor(vectors), dim=-1)[:, None]
    return Features(unit, torch.tensor(weights)[:, None], torch.ones(len(weights), 1), "basis")


def test_a_fruit_has_the_kind_that_most_of_its_pixels_speak_for() -> None:
    seen = features([1.0, 1.0, 5.0], [[0.9, 0.2, 0.3, 0.0], [0.9, 0.2, 0.3, 0.0], [0.2, 0.9, 0.3, 0.0]])
    assert likely_kinds(seen, [np.array([0, 1, 2]), np.array([0, 1])], KINDS).tolist() == [1, 0]


def test_a_fruit_that_no_gaussian_shows_has_no_kind() -> None:
    unseen = features([0.0], [[1.0, 0.0, 0.0, 0.0]])
    none = np.zeros(0, np.int64)
    assert likely_kinds(unseen, [none, np.array([0])], KINDS).tolist() == [UNKNOWN_KIND, UNKNOWN_KIND]
