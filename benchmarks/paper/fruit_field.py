"""FruitNeRF's Fruit Field in Gaussians: one number for each, learnt from binary masks of the photos.

Meyer et al. 2024, "FruitNeRF: A Unified Neural Radiance Field based Fruit Counting Framework": a field is blended along
each ray with the weights of the colours, and the binary cross-entropy of its sigmoid with the mask is the loss; the
shape of the scene gets no gradient from it.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch
from torch import Tensor

from ...engine.config import Config
from ...engine.errors import EncoderError
from ...engine.language.encoders.open_encoder import open_encoder
from ...engine.language.features.photo_features import load_photo_features
from ...engine.language.prompts.photo_probability import photo_probabilities
from ...engine.publishing import Result
from ...engine.reconstruction import PHOTOS
from ...engine.scene.camera import Camera
from ...engine.splatting.gaussians import Gaussians
from ...engine.splatting.rendering.rasterize import render

STEPS, RATE = 300, 0.1
UNSEEN = -2.0
"""The number of every Gaussian before training: those that no photo shows are no fruit."""


def learn_fruit_field(result: Result, prompts: Sequence[str], config: Config, *, seed: int = 0) -> Tensor:
    """Return the probability (N,) that each Gaussian of a result is fruit, learnt from the masks of the prompts in the
    photos.

    Raises:
        EncoderError: the encoder gives no masks of photos, as CLIP does not.
    """
    encoder, file = open_encoder(config.embed), result.out / PHOTOS
    photos = load_photo_features(file) if file.is_file() else None
    maps = None if photos is None else photo_probabilities(photos, result.features, encoder, prompts)
    if maps is None:
        raise EncoderError("This encoder gives no masks of photos. Use the embedded one: --encoder embedded")
    masks = [torch.from_numpy(each.probability >= config.count.threshold) for each in maps]
    cameras = [
        camera.resize(mask.shape[1], mask.shape[0]) for camera, mask in zip(result.scene.cameras, masks, strict=True)
    ]
    return learn(result.gaussians, cameras, masks, seed=seed)


def learn(gaussians: Gaussians, cameras: Sequence[Camera], masks: Sequence[Tensor], *, seed: int = 0) -> Tensor:
    """Return (N,) the sigmoid of the field, after STEPS steps of one view each. masks: (H, W) bool, one for each
    camera."""
    random = np.random.default_rng(seed)
    numbers = torch.full((len(gaussians), 1), UNSEEN, requires_grad=True)
    optimiser = torch.optim.Adam([numbers], lr=RATE)
    order = np.concatenate([random.permutation(len(cameras)) for _ in range(-(-STEPS // len(cameras)))])[:STEPS]
    for view in order:
        drawn = render(gaussians, cameras[view], features=numbers).features
        assert drawn is not None
        optimiser.zero_grad()
        torch.nn.functional.binary_cross_entropy_with_logits(drawn[..., 0], masks[view].float()).backward()
        optimiser.step()
    return numbers.detach()[:, 0].sigmoid()
