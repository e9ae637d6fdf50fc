"""Time and memory of every stage from photos to probabilities, with the embedded encoder and with masks and CLIP."""

from __future__ import annotations

import tempfile
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from ..engine.config import EmbedConfig, SceneConfig
from ..engine.language.encoders.encoder import sees_crops, sees_whole
from ..engine.language.features.autoencoder import train_autoencoders
from ..engine.language.features.cells import cell_weights
from ..engine.language.features.embedder import Embedder
from ..engine.language.features.features import Features
from ..engine.language.features.lift import encode_photos, lift_features
from ..engine.language.features.lift_segments import mix_features
from ..engine.language.masks.photo_segments import segment_views
from ..engine.language.prompts.relevancy import relevancy
from ..engine.photo_size import photo_scales
from ..engine.progress import Progress, part, silent
from ..engine.scene.camera import Scene
from ..engine.scene.read import read_scene
from ..engine.splatting.gaussians import Gaussians
from ..engine.splatting.ply import read_ply
from .stopwatch import Stage, Stopwatch

PROMPT, NEGATIVES = "apple", ("leaf", "green pear", "branch")


def measure_language(
    source: Path, ply: Path, configs: Sequence[EmbedConfig], *, views: int = 0, progress: Progress = silent
) -> list[Stage]:
    """Give the Gaussians of a .ply features from the photos of their scene, with each of the settings, and query them.

    views: number of photos; 0: all.

    Raises:
        FruitLangsError: the scene, the Gaussians or a checkpoint cannot be read.
    """
    scene = _select_some(read_scene(source, SceneConfig()), views)
    gaussians = read_ply(ply)
    return [
        row
        for place, config in enumerate(configs)
        for row in _pipeline(scene, gaussians, config, part(progress, place / len(configs), (place + 1) / len(configs)))
    ]


def _pipeline(scene: Scene, gaussians: Gaussians, config: EmbedConfig, progress: Progress) -> list[Stage]:
    watch = Stopwatch()
    with watch.running():
        with watch.stage("open"):
            embedder = Embedder.open(config)
        features = (_lift if embedder.segmenter is None else _mix)(watch, scene, gaussians, embedder, progress)
        for name, negatives in (("ask a word", ()), ("ask with three negatives", NEGATIVES)):
            with watch.stage(name):
                relevancy(features, embedder.encoder, [PROMPT], negatives)
    return watch.rows(config.encoder if embedder.segmenter is None else f"{config.encoder}, {config.masks} masks")


def _lift(watch: Stopwatch, scene: Scene, gaussians: Gaussians, embedder: Embedder, progress: Progress) -> Features:
    assert sees_whole(embedder.encoder)
    with watch.stage("measure the width of fruit"):
        scales = photo_scales(scene, embedder.encoder)
    photos = watch.each("encode a photo", encode_photos(scene, embedder.encoder, scales))
    with watch.stage("lift"):
        return lift_features(gaussians, scene.cameras, photos, encoder_id=embedder.encoder.identity, progress=progress)


def _mix(watch: Stopwatch, scene: Scene, gaussians: Gaussians, embedder: Embedder, progress: Progress) -> Features:
    assert embedder.segmenter is not None
    assert sees_crops(embedder.encoder)
    segmenter: Any = _Timed(embedder.segmenter, watch, {"segment": "find a photo's masks"})
    encoder: Any = _Timed(embedder.encoder, watch, {"encode_crops": "look at a batch of masks"})
    with tempfile.TemporaryDirectory() as cache:
        views = segment_views(scene, segmenter, encoder, Path(cache), part(progress, 0.0, 0.8))
        with watch.stage("sum weights"):
            table = cell_weights(gaussians, scene.cameras, watch.each("crop and keep a photo's masks", views))
    with watch.stage("multiply by the masks' features"):
        features = mix_features(table, len(gaussians), encoder_id=embedder.encoder.identity)
    with watch.stage("learn codes (joint training only)"):
        train_autoencoders([table.vectors], embedder.config, progress=part(progress, 0.8, 1.0))
    return features


class _Timed:
    """An object with some methods timed as stages."""

    def __init__(self, inner: object, watch: Stopwatch, stages: dict[str, str]) -> None:
        self._inner, self._watch, self._stages = inner, watch, stages

    def __getattr__(self, name: str) -> Any:
        found = getattr(self._inner, name)
        if name not in self._stages:
            return found

        def call_timed(*arguments: Any, **named: Any) -> Any:
            with self._watch.stage(self._stages[name]):
                return found(*arguments, **named)

        return call_timed


def _select_some(scene: Scene, views: int) -> Scene:
    """Return the scene with this many of its photos, spread over all; 0: all."""
    if not 0 < views < len(scene.images):
        return scene
    chosen = [round(place * (len(scene.images) - 1) / max(views - 1, 1)) for place in range(views)]
    return replace(scene, cameras=[scene.cameras[i] for i in chosen], images=[scene.images[i] for i in chosen])
