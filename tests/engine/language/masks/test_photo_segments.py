"""Views with masks and features: made once, kept, read again, and made by the whole crop pipeline."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from checkpoints import write_clip

from fruitlangs.engine.errors import Cancelled, SceneError
from fruitlangs.engine.language.encoders.clip import ClipEncoder
from fruitlangs.engine.language.masks.classical import ClassicalSegmenter
from fruitlangs.engine.language.masks.photo_segments import segment_views
from fruitlangs.engine.language.masks.segments import Segments, number_masks
from fruitlangs.engine.progress import Progress, silent
from fruitlangs.engine.scene.camera import ArrayPhoto, Camera, Scene

HEIGHT, WIDTH = 30, 40


class Quarters:
    """Two levels: the four quarters, and the two halves; counts how often it was asked."""

    identity = "quarters"

    def __init__(self) -> None:
        self.asked = 0

    def segment(self, image: np.ndarray, *, progress: Progress = silent) -> Segments:
        self.asked += 1
        height, width = image.shape[:2]
        down, right = np.mgrid[:height, :width] * 2 // np.array([height, width])[:, None, None]
        return number_masks(np.stack([2 * down + right, right]).astype(np.int32))


class Nothing(Quarters):
    identity = "nothing"

    def segment(self, image: np.ndarray, *, progress: Progress = silent) -> Segments:
        return Segments(np.full((3, *image.shape[:2]), -1, np.int32), 0)


class MeanColour:
    """A crop's mean colour, where it is not black; counts how many crops it saw."""

    dimension = 3

    def __init__(self, identity: str = "mean") -> None:
        self.identity, self.seen = identity, 0

    def encode_crops(self, crops: list[np.ndarray]) -> torch.Tensor:
        self.seen += len(crops)
        means = [torch.from_numpy(crop[crop.any(-1)].mean(0)).float() for crop in crops]
        return torch.nn.functional.normalize(torch.stack(means), dim=-1)


def scene(views: int = 3, valid: np.ndarray | None = None) -> Scene:
    generator = np.random.default_rng(0)
    photos = [
        ArrayPhoto(f"{view}.png", generator.integers(1, 256, (HEIGHT, WIDTH, 3)).astype(np.uint8), valid)
        for view in range(views)
    ]
    camera = Camera(np.eye(3), np.eye(4), WIDTH, HEIGHT)
    return Scene([camera] * views, photos, np.zeros((0, 3)), np.zeros((0, 3), np.uint8), np.array([0.0, 0.0, 1.0]))


def test_each_mask_has_the_feature_of_its_crop(tmp_path):
    given = scene()
    views = list(segment_views(given, Quarters(), MeanColour(), tmp_path))
    assert len(views) == 3
    for view, photo in zip(views, given.images, strict=True):
        assert view.labels.shape == (2, HEIGHT, WIDTH)
        assert view.vectors.shape == (6, 3)
        assert torch.allclose(view.vectors.norm(dim=1), torch.ones(6))
        for number in range(6):
            level = 0 if number < 4 else 1
            mean = photo.array[view.labels[level] == number].mean(0)
            assert torch.allclose(view.vectors[number], torch.tensor(mean / np.linalg.norm(mean)).float(), atol=1e-3)


def test_what_is_kept_is_not_made_again_and_is_the_same_bits(tmp_path):
    segmenter, encoder = Quarters(), MeanColour()
    first = list(segment_views(scene(), segmenter, encoder, tmp_path))
    again = list(segment_views(scene(), segmenter, encoder, tmp_path))
    assert (segmenter.asked, encoder.seen) == (3, 18)
    for made, read in zip(first, again, strict=True):
        assert (made.labels == read.labels).all()
        assert made.labels.dtype == read.labels.dtype == np.int32
        assert torch.equal(made.vectors, read.vectors)


@pytest.mark.parametrize("change", ["photo", "mask", "segmenter", "encoder"])
def test_another_photo_mask_segmenter_or_encoder_is_made_again(tmp_path, change):
    inner = np.arange(WIDTH) < np.full((HEIGHT, 1), WIDTH - 1)
    list(segment_views(scene(1, inner), Quarters(), MeanColour(), tmp_path))
    given, segmenter, encoder = scene(1, inner), Quarters(), MeanColour()
    if change == "photo":
        given.images[0].array[0, 0] ^= 1
    if change == "mask":
        given = scene(1, inner[:, ::-1])
    if change == "segmenter":
        segmenter.identity = "other"
    if change == "encoder":
        encoder.identity = "other"
    list(segment_views(given, segmenter, encoder, tmp_path))
    assert encoder.seen == 6


def test_a_stopped_run_goes_on_where_it_was(tmp_path):
    segmenter, encoder = Quarters(), MeanColour()

    def stop_at_the_third(fraction: float, message: str) -> None:
        if fraction >= 2 / 3:
            raise Cancelled

    with pytest.raises(Cancelled):
        list(segment_views(scene(), segmenter, encoder, tmp_path, stop_at_the_third))
    assert segmenter.asked == 2
    list(segment_views(scene(), segmenter, encoder, tmp_path))
    assert segmenter.asked == 3
    assert not list(tmp_path.rglob("*.part*"))


def test_a_damaged_view_on_disk_is_made_again(tmp_path):
    segmenter = Quarters()
    list(segment_views(scene(1), segmenter, MeanColour(), tmp_path))
    (path,) = tmp_path.rglob("*.safetensors")
    whole = path.read_bytes()
    for damaged in (whole[: len(whole) // 2], b"", whole[:-90] + b"x" * 90):
        path.write_bytes(damaged)
        list(segment_views(scene(1), segmenter, MeanColour(), tmp_path))
    assert segmenter.asked == 4
    assert path.read_bytes() == whole


def test_pixels_that_the_photos_mask_excludes_are_in_no_mask_and_no_crop(tmp_path):
    valid = np.zeros((HEIGHT, WIDTH), bool)
    valid[:, : WIDTH // 2] = True
    encoder = MeanColour()
    (view,) = segment_views(scene(1, valid), Quarters(), encoder, tmp_path)
    assert (view.labels[:, ~valid] == -1).all()
    assert (view.labels[:, valid] >= 0).all()
    assert view.vectors.shape == (3, 3)
    assert encoder.seen == 3


@pytest.mark.parametrize("case", ["no masks", "all excluded"])
def test_a_view_without_masks_is_all_minus_one_and_has_no_vectors(tmp_path, case):
    segmenter = Nothing() if case == "no masks" else Quarters()
    given = scene(2, None if case == "no masks" else np.zeros((HEIGHT, WIDTH), bool))
    for _ in range(2):
        for view in segment_views(given, segmenter, MeanColour(), tmp_path):
            assert (view.labels == -1).all()
            assert view.vectors.shape == (0, 3)


def test_one_view_is_made_at_a_time(tmp_path):
    segmenter = Quarters()
    views = segment_views(scene(), segmenter, MeanColour(), tmp_path)
    next(views)
    assert segmenter.asked == 1


def test_a_photo_of_another_size_than_its_camera_is_an_error(tmp_path):
    given = scene(1)
    given.images[0] = ArrayPhoto("7.png", np.zeros((HEIGHT, WIDTH + 1, 3), np.uint8))
    with pytest.raises(SceneError, match=r"7\.png has 41×30 pixels, its camera 40×30"):
        list(segment_views(given, Quarters(), MeanColour(), tmp_path))


def test_progress_rises_to_one_within_and_between_views(tmp_path, monkeypatch):
    monkeypatch.setattr("fruitlangs.engine.language.masks.photo_segments.BATCH", 2)
    told: list[float] = []
    list(segment_views(scene(2), Quarters(), MeanColour(), tmp_path, lambda fraction, _: told.append(fraction)))
    assert told == sorted(told)
    assert told[-1] == 1.0
    assert len(told) == 2 * (1 + 3) + 1


def test_the_whole_crop_pipeline_runs_on_a_checkpoint_from_disk(tmp_path):
    encoder = ClipEncoder.open(str(write_clip(tmp_path / "tiny")))
    (view,) = segment_views(scene(1), ClassicalSegmenter(), encoder, tmp_path / "cache")
    assert view.labels.max() + 1 == len(view.vectors) > 3
    assert torch.allclose(view.vectors.norm(dim=1), torch.ones(len(view.vectors)))
    unlike = ClipEncoder.open(str(write_clip(tmp_path / "other", seed=1)))
    (other,) = segment_views(scene(1), ClassicalSegmenter(), unlike, tmp_path / "cache")
    assert not torch.allclose(view.vectors, other.vectors)
