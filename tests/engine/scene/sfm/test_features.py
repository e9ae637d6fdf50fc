"""How features of photos are described."""

from __future__ import annotations

import pytest

from fruitlangs.engine.scene.sfm.features import are_small
from fruitlangs.engine.scene.sfm.job import Copy

SMALL, LARGE = (640, 480), (1600, 1200)


def copies(*sizes: tuple[int, int]) -> list[Copy]:
    return [
        Copy(name=f"{n}", width=w, height=h, copy=f"{n}.png", copy_width=w, copy_height=h, focal=0.0)
        for n, (w, h) in enumerate(sizes)
    ]


@pytest.mark.parametrize(
    ("sizes", "small"),
    [([SMALL] * 5, True), ([LARGE] * 5, False), ([LARGE, *[SMALL] * 4], True), ([SMALL, *[LARGE] * 4], False)],
)
def test_one_photo_of_another_size_does_not_choose_how_all_are_described(
    sizes: list[tuple[int, int]], small: bool
) -> None:
    assert are_small(copies(*sizes)) is small
