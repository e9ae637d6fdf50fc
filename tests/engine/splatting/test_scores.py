"""A reconstruction is judged alike in photos of any size."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from splats import random_gaussians, ring_camera

from fruitlangs.engine.counting.accounts.zero import BLURRED_SSIM, Quality
from fruitlangs.engine.scene.camera import Camera
from fruitlangs.engine.scene.photos.resample import shrink
from fruitlangs.engine.splatting.gaussians import Gaussians
from fruitlangs.engine.splatting.rendering.rasterize import render
from fruitlangs.engine.splatting.training.photos import Picture
from fruitlangs.engine.splatting.training.scores import JUDGED_SIDE, ViewScore, _reduce, score_view

LARGER = 3


@pytest.fixture(scope="module")
def gaussians() -> Gaussians:
    found = random_gaussians(200, 0, 3, log_scale=-1.5)
    found.opacity_logits.add_(2.0)
    return found


@pytest.fixture(scope="module")
def camera() -> Camera:
    """Of photos of JUDGED_SIDE."""
    return ring_camera(width=JUDGED_SIDE, height=225, focal=250.0)


@pytest.fixture(scope="module")
def photo(gaussians: Gaussians, camera: Camera) -> np.ndarray:
    """A photo LARGER times as large: the render with leaves that are too fine for Gaussians."""
    color = render(gaussians, camera.scale(LARGER)).color.numpy()
    leaves = np.random.default_rng(0).normal(0.0, 0.08, color.shape[:2])
    return np.clip(255.0 * (color + leaves[..., None]), 0, 255).astype(np.uint8)


def score(gaussians: Gaussians, camera: Camera, photo: np.ndarray, mask: np.ndarray | None = None) -> ViewScore:
    return score_view(gaussians, Picture(camera, photo, mask, 0), "a.jpg", exposure=False)


def judged(score: ViewScore) -> Quality:
    return Quality(score.reduced_psnr, score.reduced_ssim)


def test_the_same_gaussians_are_judged_alike_in_photos_of_three_times_the_size(
    gaussians: Gaussians, camera: Camera, photo: np.ndarray
) -> None:
    small = np.rint(shrink(photo.astype(np.float32), camera.width, camera.height)).astype(np.uint8)
    one, three = score(gaussians, camera, small), score(gaussians, camera.scale(LARGER), photo)
    assert three.ssim < BLURRED_SSIM < one.ssim  # the same Gaussians would be poor in one and good in the other
    assert three.reduced_ssim == pytest.approx(one.reduced_ssim, abs=0.01)
    assert three.reduced_psnr == pytest.approx(one.reduced_psnr, abs=0.5)
    assert judged(one).blurred == judged(three).blurred is False


def test_photos_of_the_judged_size_are_judged_as_they_are(
    gaussians: Gaussians, camera: Camera, photo: np.ndarray
) -> None:
    small = np.ascontiguousarray(photo[: camera.height, : camera.width])
    found = score(gaussians, camera, small)
    assert (found.reduced_psnr, found.reduced_ssim) == (found.psnr, found.ssim)


def test_what_a_mask_excludes_does_not_count_at_the_judged_size_either(
    gaussians: Gaussians, camera: Camera, photo: np.ndarray
) -> None:
    mask = np.ones(photo.shape[:2], bool)
    mask[:100] = False
    spoilt = photo.copy()
    spoilt[:90] = 255 - spoilt[:90]
    whole, masked = (score(gaussians, camera.scale(LARGER), each, mask) for each in (photo, spoilt))
    assert masked.reduced_psnr == whole.reduced_psnr
    assert masked.reduced_ssim == pytest.approx(whole.reduced_ssim, abs=1e-3)


def test_a_mask_too_fine_for_the_judged_size_is_used_at_full_size(
    gaussians: Gaussians, camera: Camera, photo: np.ndarray
) -> None:
    mask = np.zeros(photo.shape[:2], bool)
    mask[::2] = True
    found = score(gaussians, camera.scale(LARGER), photo, mask)
    assert (found.reduced_psnr, found.reduced_ssim) == (found.psnr, found.ssim)
    assert np.isfinite([found.psnr, found.ssim]).all()


def test_colors_beyond_white_are_white_before_they_are_averaged(camera: Camera) -> None:
    checks = np.indices((2 * camera.height, 2 * camera.width)).sum(axis=0) % 2
    photo = np.repeat(255 * checks[..., None], 3, axis=2).astype(np.uint8)
    found = _reduce(torch.from_numpy(photo / 100.0).float(), Picture(camera.scale(2), photo, None, 0))
    assert found.color.numpy() == pytest.approx(0.5)
    assert found.photo == pytest.approx(128)
