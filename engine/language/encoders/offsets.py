"""Where on its fruit each pixel lies: touching fruit are one in a mask, but not here.

A second output of the embedded encoder's network. The shading of a round fruit, its outline and what covers it tell
where its centre is, also where only a part of it shows. Trained by `scripts/developer/fit_offsets.py`.
"""

from __future__ import annotations

import hashlib
from functools import cache
from pathlib import Path

import torch
from torch import Tensor, nn
from torch.nn import functional

from ...errors import EncoderError
from ...storage.files import halve_precision, read_tensors, write_tensors
from .network import WIDTHS, Unit, fuse_units

STORED = Path(__file__).resolve().parent / "weights" / "offsets.safetensors"
FORMAT = "fruitlangs-offsets-1"
OWN_WIDTHS = (32, 48, 64, 96)
"""Channels at strides 2, 4, 8 and 16."""


class OffsetNetwork(nn.Module):
    """The features of the encoder's network at each stride → (B, 3, H/2, W/2): how far right and down from the centre
    of its fruit a pixel lies, in radii of the fruit, as if it were a sphere and whole; and the logarithm of the error.

    On pixels without fruit the numbers mean nothing.
    """

    def __init__(self) -> None:
        super().__init__()
        self.lateral = nn.ModuleList(nn.Conv2d(width, own, 1) for width, own in zip(WIDTHS, OWN_WIDTHS, strict=True))
        self.deep = Unit(OWN_WIDTHS[-1], OWN_WIDTHS[-1])
        pairs = list(zip(OWN_WIDTHS[:0:-1], OWN_WIDTHS[-2::-1], strict=True))
        self.down = nn.ModuleList(nn.Conv2d(deep, shallow, 1) for deep, shallow in pairs)
        self.up = nn.ModuleList(nn.Sequential(Unit(shallow, shallow), Unit(shallow, shallow)) for _, shallow in pairs)
        self.head = nn.Conv2d(OWN_WIDTHS[0], 3, 1)

    def forward(self, levels: list[Tensor]) -> Tensor:
        own = [lateral(level) for lateral, level in zip(self.lateral, levels, strict=True)]
        image = self.deep(own[-1])
        for down, up, level in zip(self.down, self.up, own[-2::-1], strict=True):
            coarse = functional.interpolate(down(image), scale_factor=2.0, mode="bilinear", align_corners=False)
            image = up(coarse + level)
        off, error = self.head(image).split((2, 1), dim=1)
        return torch.cat([off, error.clamp(-4.0, 2.0)], dim=1)

    def fuse(self) -> OffsetNetwork:
        """Ready for inference: normalisation folded into the convolutions."""
        fuse_units(self)
        return self


@cache
def load_offsets(encoder: str, path: Path = STORED) -> OffsetNetwork:
    """Load the network that comes with the package, fused. encoder: identity of the encoder whose features it gets.

    Raises:
        EncoderError: the weights are missing, damaged, or made for another encoder.
    """
    return read_offsets(encoder, path).fuse()


@cache
def offsets_identity(path: Path = STORED) -> str:
    """Name and fingerprint of the network in a file.

    Raises:
        EncoderError: the file is missing.
    """
    try:
        return f"offsets-{hashlib.sha256(path.read_bytes()).hexdigest()[:16]}"
    except OSError as error:
        raise EncoderError(f"The weights {path} are missing ({error.strerror}). Install the package again") from error


def read_offsets(encoder: str, path: Path) -> OffsetNetwork:
    """A network that `save_offsets` wrote, unfused.

    Raises:
        EncoderError: the weights are missing, damaged, or made for another encoder.
    """
    try:
        tensors, header = read_tensors(path)
        if header["format"] != FORMAT or header["encoder"] != encoder:
            raise ValueError(f"{header['format']} for {header['encoder']}")
        network = OffsetNetwork()
        network.load_state_dict({name: tensor.float() for name, tensor in tensors.items()})
    except (KeyError, TypeError, ValueError, RuntimeError, OSError) as error:
        raise EncoderError(
            f"The weights {path} do not fit the encoder {encoder} ({str(error).splitlines()[0]}). "
            "Install the package again, or train them again with scripts/developer/fit_offsets.py"
        ) from error
    return network


def save_offsets(path: Path, network: OffsetNetwork, encoder: str, **notes: object) -> None:
    """Write an unfused network in half precision; encoder: identity of the encoder that it was trained for."""
    write_tensors(path, halve_precision(network.state_dict()), {"format": FORMAT, "encoder": encoder, **notes})
