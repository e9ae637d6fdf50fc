"""Features for a scene's Gaussians, by the road that the settings name: whole photos or masks, lifted or trained."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path

from ...config import EmbedConfig
from ...errors import ConfigError
from ...progress import Progress, part, silent
from ...scene.camera import Scene
from ...splatting.gaussians import Gaussians
from ..encoders.encoder import CropEncoder, DenseEncoder, sees_crops, sees_whole
from ..encoders.open_encoder import open_encoder
from ..masks.photo_segments import segmented_views
from ..masks.segmenter import Segmenter, open_segmenter
from ..masks.segments import SegmentedView
from .features import Features
from .joint import Semantics, prepare_joint
from .lift import encode_photos, lift_features
from .lift_segments import lift_segments


@dataclass(frozen=True, eq=False)
class Embedder:
    """An encoder with what finds masks for it, None where it sees photos whole, and how their features are used."""

    encoder: DenseEncoder | CropEncoder
    segmenter: Segmenter | None
    config: EmbedConfig

    @classmethod
    def open(cls, config: EmbedConfig) -> Embedder:
        """What the settings name.

        Raises:
            EncoderError: weights are missing, unsafe or unreadable.
            ConfigError: codes shall be trained along for an encoder that has no masks.
        """
        encoder = open_encoder(config)
        whole = sees_whole(encoder)
        if whole and config.features == "joint":
            raise ConfigError(
                f"--features joint trains codes of masks, and encoder '{config.encoder}' has none. Give --encoder clip "
                "with it, or --features lift"
            )
        return cls(encoder, None if whole else open_segmenter(config), config)

    @property
    def trains(self) -> bool:
        """Whether features are trained along with the Gaussians rather than lifted into them."""
        return self.config.features == "joint"

    @property
    def key(self) -> str:
        """What features depend on beside the scene and its Gaussians; not where a checkpoint lies."""
        if self.segmenter is None:
            return self.encoder.identity
        return f"{self.encoder.identity} {self.segmenter.identity} {asdict(portable(self.config))}"

    def lift(self, gaussians: Gaussians, scene: Scene, cache: Path, *, progress: Progress = silent) -> Features:
        """Features of the scene's photos averaged into the Gaussians; those of masks are kept in `cache`.

        Raises:
            SceneError: a photo cannot be read, or no photo has a mask.
            OutputError: `cache` cannot be written.
            Cancelled: `progress` asked for it.
        """
        identity = self.encoder.identity
        if sees_whole(self.encoder):
            return lift_features(
                gaussians,
                scene.cameras,
                encode_photos(scene, self.encoder),
                encoder_id=identity,
                progress=progress,
            )
        return lift_segments(
            gaussians,
            scene.cameras,
            self.views(scene, cache, progress=part(progress, 0.0, 0.8)),
            encoder_id=identity,
            rounds=self.config.rounds,
            progress=part(progress, 0.8, 1.0),
        )

    def views(self, scene: Scene, cache: Path, *, progress: Progress = silent) -> Iterator[SegmentedView]:
        """Every photo's masks with their features, one view at a time, kept in `cache`."""
        assert self.segmenter is not None
        assert sees_crops(self.encoder)
        return segmented_views(scene, self.segmenter, self.encoder, cache, progress)

    def prepare(self, scene: Scene, views: Sequence[SegmentedView], *, progress: Progress = silent) -> Semantics:
        """What training needs to train codes along."""
        return prepare_joint(scene.cameras, views, self.config, encoder_id=self.encoder.identity, progress=progress)


def portable(config: EmbedConfig) -> EmbedConfig:
    """The settings without what another computer may have elsewhere: two that are equal give equal features."""
    return replace(config, clip="", sam="", allow_download=False)
