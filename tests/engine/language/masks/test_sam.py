"""SAM's masks become three label maps: by a model whose answers are known, and by the real class."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest
import torch
from checkpoints import write_sam

from fruitlangs.engine.config import EmbedConfig
from fruitlangs.engine.errors import Cancelled
from fruitlangs.engine.language.encoders.checkpoints import Checkpoint
from fruitlangs.engine.language.masks import sam
from fruitlangs.engine.language.masks.segmenter import open_segmenter

SIDE, GRID = 64, 32


@pytest.fixture(autouse=True)
def few_points(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sam, "POINTS_A_SIDE", 4)


def disc(x: float, y: float, radius: float) -> torch.Tensor:
    """(GRID, GRID) logits of a disc; centre and radius in pixels of the model's square."""
    cells = (torch.arange(GRID) + 0.5) * SIDE / GRID
    return 4.0 * (radius - ((cells[None] - x) ** 2 + (cells[:, None] - y) ** 2).sqrt())


class Known:
    """A model that answers point i with `answers[i]` in any order of size, and with nothing where it has none."""

    device, dtype = torch.device("cpu"), torch.float32
    config = SimpleNamespace(vision_config=SimpleNamespace(image_size=SIDE))

    def __init__(self, *answers: list[torch.Tensor], predicted: float = 0.9) -> None:
        self.answers, self.predicted, self.embedded, self.points = list(answers), predicted, 0, []

    def get_image_embeddings(self, pixels: torch.Tensor) -> torch.Tensor:
        self.embedded += 1
        return pixels

    def __call__(self, *, image_embeddings, input_points, multimask_output):
        count = input_points.shape[1]
        self.points.append(input_points[0, :, 0])
        nothing = [torch.full((GRID, GRID), -9.0)] * 3
        answers = [self.answers.pop(0) if self.answers else nothing for _ in range(count)]
        masks = torch.stack([torch.stack(answer) for answer in answers])
        return SimpleNamespace(pred_masks=masks[None], iou_scores=torch.full((1, count, 3), self.predicted))


def segmenter(model: Known, height: int = SIDE, width: int = SIDE) -> sam.SamSegmenter:
    def pictures(images, return_tensors):
        return {"pixel_values": torch.zeros(1, 3, SIDE, SIDE), "reshaped_input_sizes": [[height, width]]}

    return sam.SamSegmenter(Checkpoint(model, pictures, None, "known"))


def black(height: int, width: int) -> np.ndarray:
    return np.zeros((height, width, 3), np.uint8)


def test_the_three_answers_are_the_levels_by_size():
    model = Known([disc(32, 32, 28), disc(32, 32, 8), disc(32, 32, 16)])
    segments = segmenter(model).segment(black(SIDE, SIDE))
    assert segments.count == 3
    areas = [int((labels >= 0).sum()) for labels in segments.labels]
    assert areas == pytest.approx([np.pi * radius**2 for radius in (8, 16, 28)], rel=0.06)


def test_masks_are_where_they_were_in_a_photo_of_another_size_and_shape():
    # 240×120 pixels fill the upper half of the square; the disc is a quarter from the left.
    model = Known([disc(16, 16, 9)] * 3)
    segments = segmenter(model, height=32, width=64).segment(black(120, 240))
    rows, columns = np.nonzero(segments.labels[0] >= 0)
    assert (rows.mean(), columns.mean()) == pytest.approx((59.5, 59.5), abs=1.0)
    assert len(rows) == pytest.approx(np.pi * (9 * 240 / 64) ** 2, rel=0.05)


def test_duplicates_of_a_level_are_one_mask_and_what_lies_on_a_larger_mask_is_not_hidden():
    references, spot = [disc(30, 30, 20)] * 3, [disc(30, 30, 8)] * 3
    model = Known(spot, references, [disc(31, 30, 20)] * 3)
    labels = segmenter(model).segment(black(SIDE, SIDE)).labels[0]
    assert set(np.unique(labels)) == {-1, 0, 1}
    assert labels[30, 30] != labels[30, 14]
    assert labels[30, 14] >= 0


@pytest.mark.parametrize("fault", ["unsure", "unsteady", "small"])
def test_a_mask_that_is_uncertain_unstable_or_small_is_left_out(fault):
    good = disc(32, 32, 20)
    mask = {"unsure": good, "unsteady": good / 40.0, "small": disc(32, 32, 5)}[fault]
    model = Known([mask] * 3, predicted=0.69 if fault == "unsure" else 0.71)
    segments = segmenter(model).segment(black(SIDE, SIDE))
    assert segments.count == 0
    assert segments.labels.shape == (3, SIDE, SIDE)
    assert (segments.labels == -1).all()


def test_a_wish_to_stop_is_heard_between_two_batches_of_points(monkeypatch):
    monkeypatch.undo()
    model = Known()

    def stop_at_the_third(fraction: float, message: str) -> None:
        if fraction >= 2 * sam.BATCH / sam.POINTS_A_SIDE**2:
            raise Cancelled(message)

    with pytest.raises(Cancelled, match=f"point {2 * sam.BATCH + 1} of"):
        segmenter(model).segment(black(SIDE, SIDE), progress=stop_at_the_third)
    assert len(torch.cat(model.points)) == 2 * sam.BATCH


def test_the_photo_is_embedded_once_and_asked_at_a_grid_of_points_over_it(monkeypatch):
    monkeypatch.undo()
    model = Known()
    segmenter(model, height=32, width=64).segment(black(120, 240))
    points = torch.cat(model.points)
    assert model.embedded == 1
    assert len(points.unique(dim=0)) == 32 * 32
    assert (points.amin(0).tolist(), points.amax(0).tolist()) == ([1.0, 0.5], [63.0, 31.5])


def test_a_sam_on_disk_gives_masks_the_same_each_time(tmp_path):
    opened = open_segmenter(EmbedConfig(masks="sam", sam=str(write_sam(tmp_path / "tiny-sam"))))
    assert opened.identity.startswith("tiny-sam-")
    image = np.random.default_rng(0).integers(0, 256, (60, 80, 3)).astype(np.uint8)
    first, again = opened.segment(image), opened.segment(image)
    assert first.labels.shape == (3, 60, 80)
    assert first.count == len(np.unique(first.labels)) - 1 > 0
    assert (first.labels == again.labels).all()
