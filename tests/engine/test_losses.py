"""The fused loss against plain torch, and the metrics on cases with known answers."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
import torch.nn.functional as F
from torch import Tensor

from fruitlangs.engine.splatting.losses import photometric_loss, psnr, ssim


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


@pytest.mark.parametrize("masked", [False, True])
@pytest.mark.parametrize("size", [(37, 53), (16, 64), (5, 3)])
def test_loss_and_gradient_agree_with_plain_torch(size: tuple[int, int], masked: bool) -> None:
    random = np.random.default_rng(0)
    photo = random.integers(0, 256, (*size, 3)).astype(np.uint8)
    mask = random.random(size) > 0.4 if masked else np.ones(size, bool)
    color = torch.from_numpy(random.random((*size, 3))).float().requires_grad_()
    twin = color.detach().double().requires_grad_()
    loss = photometric_loss(color, photo, ssim_weight=0.3, mask=mask if masked else None)
    expected = plain_loss(twin, torch.from_numpy(photo).double() / 255, 0.3, torch.from_numpy(mask))
    (2.0 * loss).backward()
    (2.0 * expected).backward()
    assert loss.item() == pytest.approx(expected.item(), rel=1e-5)
    assert color.grad is not None
    assert twin.grad is not None
    torch.testing.assert_close(color.grad.double(), twin.grad, rtol=1e-4, atol=1e-5 * float(twin.grad.abs().max()))


def test_a_perfect_rendering_costs_nothing() -> None:
    photo = np.random.default_rng(1).integers(0, 256, (20, 30, 3)).astype(np.uint8)
    color = torch.from_numpy(photo).float() / 255
    assert photometric_loss(color, photo).item() == pytest.approx(0.0, abs=1e-6)
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
    assert photometric_loss(color, photo, mask=mask).item() == pytest.approx(0.0, abs=1e-6)
    assert math.isinf(psnr(color, photo, mask=mask))
    assert photometric_loss(color, photo).item() > 0.2


def test_an_all_black_mask_costs_nothing_and_pulls_nowhere() -> None:
    color = torch.rand(6, 7, 3, requires_grad=True)
    loss = photometric_loss(color, np.zeros((6, 7, 3), np.uint8), mask=np.zeros((6, 7), bool))
    loss.backward()
    assert color.grad is not None
    assert loss.item() == 0.0
    assert float(color.grad.abs().max()) == 0.0
