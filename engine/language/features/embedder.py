"""Features for the Gaussians of a scene, by the method that the settings name: whole photos or masks, lifted or
trained."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from ...config import EmbedConfig, select_decisive
from ...errors import ConfigError
from ...progress import Progress, part, silent
from ...scene.camera import Scene
from ...splatting.gaussians import Gaussians
from ..encoders.encoder import CropEncoder, DenseEncoder, sees_crops, sees_fruit, sees_whole
from ..encoders.open_encoder import open_encoder
from ..masks.photo_segments import segment_views
from ..masks.segmenter import Segmenter, open_segmenter
from ..masks.segments import SegmentedView
from .features import Features
from .joint import Semantics, prepare_joint
from .lift import encode_photos, lift_features
from .lift_segments import lift_segments
from .photo_features import PhotoFeaturesRecorder


@dataclass(frozen=True, eq=False)
class Embedder:
    """An encoder with its segmenter, None if it processes whole photos, and how features are computed."""

    encoder: DenseEncoder | CropEncoder
    segmenter: Segmenter | None
    config: EmbedConfig

    @classmethod
    def open(cls, config: EmbedConfig) -> Embedder:
        """The embedder that the settings name.

        Raises:
            EncoderError: weights are missing, unsafe or unreadable.
            ConfigError: codes are to be trained along for an encoder without masks.
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
        """Whether features are trained together with the Gaussians rather than lifted."""
        return self.config.features == "joint"

    @property
    def key(self) -> str:
        """Text of everything that features depend on besides the scene and its Gaussians, without the path of a
        checkpoint."""
        if self.segmenter is None:
            return self.encoder.identity
        return f"{self.encoder.identity} {self.segmenter.identity} {select_decisive(self.config)}"

    def lift(
        self,
        gaussians: Gaussians,
        scene: Scene,
        cache: Path,
        *,
        scales: Sequence[Sequence[float]] = (),
        recorder: PhotoFeaturesRecorder | None = None,
        progress: Progress = silent,
    ) -> Features:
        """Average features of the photos into the Gaussians; features of masks are cached in `cache`. scales: at
        which an encoder of whole photos sees each, by default those that it chooses without knowing the fruit;
        recorder: keeps what the encoder says about pixels.

        Raises:
            SceneError: a photo cannot be read, or no photo has a mask.
            OutputError: `cache` cannot be written.
            Cancelled: `progress` asked for it.
        """
        identity = self.encoder.identity
        if sees_whole(self.encoder):
            size = self.encoder.embedding_size if sees_fruit(self.encoder) else 0
            lifted = lift_features(
                gaussians,
                scene.cameras,
                encode_photos(scene, self.encoder, scales or [()] * len(scene.images), recorder, embedded=size > 0),
                encoder_id=identity,
                embedded=size,
                progress=progress,
            )
            return replace(lifted, vectors=lifted.vectors.half())
        return lift_segments(
            gaussians,
            scene.cameras,
            self.views(scene, cache, progress=part(progress, 0.0, 0.8)),
            encoder_id=identity,
            rounds=self.config.rounds,
            progress=part(progress, 0.8, 1.0),
        )

    def views(self, scene: Scene, cache: Path, *, progress: Progress = silent) -> Views:
        """The masks of every photo with their features, one view at a time; computed by the first reader."""
        return Views(self, scene, cache, progress)

    def prepare(
        self, scene: Scene, views: Iterable[SegmentedView], spool_in: Path, *, progress: Progress = silent
    ) -> Semantics:
        """The targets for joint training of codes, with files in the folder `spool_in`."""
        return prepare_joint(
            scene.cameras,
            views,
            self.config,
            encoder_id=self.encoder.identity,
            spool_in=spool_in,
            progress=progress,
        )


class Views:
    """The masks of a scene's photos with their features, in the scene's order, for any number of readers: one view is
    in memory at a time, all are cached on disk."""

    def __init__(self, embedder: Embedder, scene: Scene, cache: Path, progress: Progress) -> None:
        self._embedder, self._scene, self._cache, self._progress = embedder, scene, cache, progress

    def __iter__(self) -> Iterator[SegmentedView]:
        segmenter, encoder = self._embedder.segmenter, self._embedder.encoder
        assert segmenter is not None
        assert sees_crops(encoder)
        yield from segment_views(self._scene, segmenter, encoder, self._cache, self._progress)
        self._progress = silent  # later readers find the views in the cache
