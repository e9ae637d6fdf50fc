"""The fused loss against plain torch, and the metrics on cases with known answers."""

from __future__ import annotations

import warnings

import numpy as np
import pytest
import torch
import torch.nn.functional as F
from numpy.typing import NDArray
from torch import Tensor

from fruitlangs.engine.splatting.rendering.workspace import Workspace
from fruitlangs.engine.splatting.training.losses import PhotometricLoss, psnr, ssim


def plain_loss(color: Tensor, photo: Tensor, ssim_weight: float, mask: Tensor) -> Tensor:
    """The loss in float64 by convolution."""
    x, y = color.permute(2, 0, 1)[None], photo.permute(2, 0, 1)[None]
    x = torch.where(mask, x, y)
    line = torch.exp(-0.5 * (torch.arange(-5, 6, dtype=torch.float64) / 1.5) ** 2)
    line = line / line.sum()
    window = (line[:, None] * line)[None, None].repeat(3, 1, 1, 1)

    def mean(image: Tensor) -> Tensor:
        return F.conv2d(image, window, padding=5, groups=3)

    mx, my = mean(x), mean(y)
    vx, vy, cov = mean(x * x) - mx * mx, mean(y * y) - my * my, mean(x * y) - mx * my
    s = (2 * mx * my + 1e-4) * (2 * cov + 9e-4) / ((mx * mx + my * my + 1e-4) * (vx + vy + 9e-4))
    valid = mask.expand_as(s)
    return (1 - ssim_weight) * (x - y).abs()[valid].mean() + ssim_weight * (1 - s[valid].mean())


def loss_of(color: Tensor, photo: NDArray[np.uint8], mask: NDArray[np.bool_] | None = None) -> float:
    image = color.permute(2, 0, 1).contiguous().numpy()
    return PhotometricLoss(0.2, Workspace()).backward(image, photo, mask, np.empty_like(image))


@pytest.mark.parametrize("masked", [False, True])
@pytest.mark.parametrize("size", [(37, 53), (16, 64), (5, 3)])
def test_loss_and_gradient_agree_with_plain_torch(size: tuple[int, int], masked: bool) -> None:
    random = np.random.default_rng(0)
    photo = random.integers(0, 256, (*size, 3)).astype(np.uint8)
    mask = random.random(size) > 0.4 if masked else np.ones(size, bool)
    image = random.random((3, *size)).astype(np.float32)
    reference = torch.from_numpy(image.transpose(1, 2, 0)).double().requires_grad_()
    expected = plain_loss(reference, torch.from_numpy(photo).double() / 255, 0.3, torch.from_numpy(mask))
    expected.backward()
    assert reference.grad is not None
    loss = PhotometricLoss(0.3, Workspace())
    for key in (None, "photo", "photo"):  # the second time the photo's moments are remembered
        gradient = np.empty_like(image)
        value = loss.backward(image, photo, mask if masked else None, gradient, key=key)
        assert value == pytest.approx(expected.item(), rel=1e-5)
        found = torch.from_numpy(gradient.transpose(1, 2, 0)).double()
        torch.testing.assert_close(found, reference.grad, rtol=1e-4, atol=1e-5 * float(reference.grad.abs().max()))


def test_a_smaller_image_after_a_larger_one_costs_what_it_costs_alone() -> None:
    random = np.random.default_rng(2)
    loss = PhotometricLoss(0.2, Workspace())
    for size in ((40, 50), (20, 25), (40, 50)):
        image, photo = random.random((3, *size)).astype(np.float32), random.integers(0, 256, (*size, 3), dtype=np.uint8)
        alone = PhotometricLoss(0.2, Workspace()).backward(image, photo, None, np.empty_like(image))
        assert loss.backward(image, photo, None, np.empty_like(image), key=size) in (
            alone,
            pytest.approx(alone, rel=1e-6),
        )
        loss = PhotometricLoss(0.2, loss.workspace)


def test_a_perfect_rendering_costs_nothing() -> None:
    photo = np.random.default_rng(1).integers(0, 256, (20, 30, 3)).astype(np.uint8)
    color = torch.from_numpy(photo).float() / 255
    assert loss_of(color, photo) == pytest.approx(0.0, abs=1e-6)
    assert ssim(color, photo) == pytest.approx(1.0, abs=1e-6)
    assert psnr(color, photo) > 100


def test_psnr_of_a_tenth_is_twenty() -> None:
    photo = np.full((8, 8, 3), 51, np.uint8)
    assert psnr(torch.full((8, 8, 3), 0.3), photo) == pytest.approx(20.0, abs=1e-3)


def test_masked_pixels_do_not_count() -> None:
    photo = np.zeros((12, 12, 3), np.uint8)
    color = torch.zeros(12, 12, 3)
    color[:4] = 1.0
    mask = np.ones((12, 12), bool)
    mask[:4] = False
    assert loss_of(color, photo, mask) == pytest.approx(0.0, abs=1e-6)
    assert psnr(color, photo, mask=mask) == 120.0
    assert loss_of(color, photo) > 0.2


def test_photos_and_masks_that_may_only_be_read_are_measured_without_a_warning() -> None:
    photo, mask = np.full((8, 8, 3), 51, np.uint8), np.ones((8, 8), bool)
    mask[:4] = False
    color = torch.full((8, 8, 3), 0.3)
    before = psnr(color, photo, mask=mask), ssim(color, photo, mask=mask)
    photo.setflags(write=False)
    mask.setflags(write=False)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert (psnr(color, photo, mask=mask), ssim(color, photo, mask=mask)) == before


def test_a_photo_a_little_narrower_than_the_last_one_sees_nothing_of_it() -> None:
    random = np.random.default_rng(5)
    loss = PhotometricLoss(0.2, Workspace())
    for width in (64, 60):  # rows of the same padded length
        image = random.random((3, 20, width)).astype(np.float32)
        photo = random.integers(0, 256, (20, width, 3), dtype=np.uint8)
        alone, gradient, expected = PhotometricLoss(0.2, Workspace()), np.empty_like(image), np.empty_like(image)
        assert loss.backward(image, photo, None, gradient) == alone.backward(image, photo, None, expected)
        np.testing.assert_array_equal(gradient, expected)


def test_an_all_black_mask_costs_nothing_and_pulls_nowhere() -> None:
    image, gradient = np.random.default_rng(3).random((3, 6, 7)).astype(np.float32), np.ones((3, 6, 7), np.float32)
    loss = PhotometricLoss(0.2, Workspace())
    assert loss.backward(image, np.zeros((6, 7, 3), np.uint8), np.zeros((6, 7), bool), gradient) == 0.0
    assert not gradient.any()
