"""The dense network of the embedded encoder: photo in, one logit per concept and pixel out."""

from __future__ import annotations

import torch
from torch import Tensor, nn
from torch.nn import functional
from torch.nn.utils.fusion import fuse_conv_bn_eval

WIDTHS = (32, 64, 128, 160)
"""Channels at strides 2, 4, 8 and 16."""
DEPTHS = (1, 2, 3, 3)
"""3×3 convolutions at each stride, after the one that reduces the resolution."""
STRIDE = 16
"""Input sides must be multiples of this."""


class Unit(nn.Module):
    """Convolution, batch normalisation, ReLU; with a skip when shapes allow one."""

    def __init__(self, inputs: int, outputs: int, *, kernel: int = 3, stride: int = 1) -> None:
        super().__init__()
        self.conv = nn.Conv2d(inputs, outputs, kernel, stride=stride, padding=kernel // 2, bias=False)
        self.norm: nn.Module = nn.BatchNorm2d(outputs)
        self.skip = inputs == outputs and stride == 1

    def forward(self, image: Tensor) -> Tensor:
        hidden = functional.relu(self.norm(self.conv(image)), inplace=True)
        return image + hidden if self.skip else hidden

    def fuse(self) -> None:
        """Fold the normalisation into the convolution (inference only)."""
        if isinstance(self.norm, nn.BatchNorm2d):
            self.conv = fuse_conv_bn_eval(self.conv, self.norm)
            self.norm = nn.Identity()


class Network(nn.Module):
    """A U-shaped network: context to stride 16, detail back to stride 2.

    No layer covers the whole photo: the receptive field is about 200 pixels, so a fruit is classified by itself and its
    surroundings.
    """

    def __init__(self, concepts: int, *, widths: tuple[int, ...] = WIDTHS, depths: tuple[int, ...] = DEPTHS) -> None:
        super().__init__()
        down: list[nn.Module] = []
        inputs = 3
        for stage, (width, depth) in enumerate(zip(widths, depths, strict=True)):
            units = [Unit(inputs, width, kernel=5 if stage == 0 else 3, stride=2)]
            units += [Unit(width, width) for _ in range(depth)]
            down.append(nn.Sequential(*units))
            inputs = width
        self.down = nn.ModuleList(down)
        pairs = list(zip(widths[:0:-1], widths[-2::-1], strict=True))
        self.lateral = nn.ModuleList(nn.Conv2d(deep, shallow, 1) for deep, shallow in pairs)
        self.up = nn.ModuleList(Unit(shallow, shallow) for _, shallow in pairs)
        self.refine = Unit(widths[0], widths[0])
        self.head = nn.Conv2d(widths[0], concepts, 1)

    def forward(self, image: Tensor) -> Tensor:
        """(B, 3, H, W) normalised colours → (B, concepts, H/2, W/2) logits; H and W are multiples of STRIDE."""
        return self.compute_logits(self.levels(image))

    def levels(self, image: Tensor) -> list[Tensor]:
        """The features of each stride, from 2 to STRIDE."""
        levels = []
        for stage in self.down:
            image = stage(image)
            levels.append(image)
        return levels

    def compute_logits(self, levels: list[Tensor]) -> Tensor:
        """Compute the logits from the features of each stride."""
        logits: Tensor = self.head(self.compute_details(levels))
        return logits

    def compute_details(self, levels: list[Tensor]) -> Tensor:
        """Compute (B, widths[0], H/2, W/2): the last features before the logits, with context and detail."""
        image = levels[-1]
        for lateral, up, level in zip(self.lateral, self.up, levels[-2::-1], strict=True):
            coarse = functional.interpolate(lateral(image), scale_factor=2.0, mode="bilinear", align_corners=False)
            image = up(coarse + level)
        detailed: Tensor = self.refine(image)
        return detailed

    def fuse(self) -> Network:
        """Ready for inference: normalisation folded into the convolutions."""
        fuse_units(self)
        return self


def fuse_units(network: nn.Module) -> None:
    """Make a network of units ready for inference, in place."""
    network.eval()
    for module in network.modules():
        if isinstance(module, Unit):
            module.fuse()
    network.to(memory_format=torch.channels_last)  # type: ignore[call-overload]


def normalise(image: Tensor) -> Tensor:
    """sRGB in [0, 1] → the network's input range."""
    return (image - 0.45) / 0.27


def count_parameters(network: nn.Module) -> int:
    return sum(parameter.numel() for parameter in network.parameters())


def levels_of(network: Network, image: Tensor) -> list[Tensor]:
    """The features of an image (3, H, W) in [0, 1], whose last row and column are repeated up to multiples of
    STRIDE."""
    batch, (height, width) = image[None], image.shape[-2:]
    bottom, right = -height % STRIDE, -width % STRIDE
    if bottom or right:
        batch = functional.pad(batch, (0, right, 0, bottom), mode="replicate")
    return network.levels(normalise(batch).contiguous(memory_format=torch.channels_last))
