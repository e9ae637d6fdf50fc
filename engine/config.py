"""The settings of every stage: declared once, shown as flags, as Blender properties and in the docs.

Field docstrings (the string below a field) are the text of the flag and of the tooltip.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import Field, dataclass, field, fields
from typing import Any, Literal

from .errors import ConfigError

LARGEST = 2**31 - 1
"""The largest whole number that every front end can hold."""


@dataclass(frozen=True)
class Range:
    """The numbers that a setting may have; `open` leaves out both ends."""

    low: float
    high: float
    open: bool = False

    def __contains__(self, value: float) -> bool:
        return self.low < value < self.high if self.open else self.low <= value <= self.high

    def __str__(self) -> str:
        if not self.open:
            return f"{self.low} to {self.high}"
        return f"a finite number above {self.low}" + ("" if math.isinf(self.high) else f" and below {self.high}")


def _number(default: float | None, low: float, high: float, *, open: bool = False) -> Any:
    """A field whose value lies in a range, or is None where that is the default."""
    return field(default=default, metadata={"range": Range(low, high, open)})


def range_of(setting: Field[Any]) -> Range | None:
    """What a field of a stage's settings may be; None where it is no number."""
    return setting.metadata.get("range")


PathKind = Literal["file", "folder"]


def _path(default: str, kind: PathKind) -> Any:
    """A field that names a file or a folder, or something else that a stage finds by name."""
    return field(default=default, metadata={"path": kind})


def path_kind(setting: Field[Any]) -> PathKind | None:
    """Whether a field of a stage's settings may be the path of a file or of a folder; None where it is no path."""
    return setting.metadata.get("path")


class _Checked:
    """Settings whose numbers are looked at when they are made."""

    def __post_init__(self) -> None:
        for setting in fields(self):  # type: ignore[arg-type]
            value, allowed = getattr(self, setting.name), range_of(setting)
            if allowed is None or (value is None and setting.default is None):
                continue
            if value not in allowed:
                flag = f"--{type(self).__name__.removesuffix('Config').lower()}.{setting.name.replace('_', '-')}"
                raise ConfigError(f"{flag} is {value}; use {allowed}")


def _finite(values: Any) -> tuple[float, ...]:
    """The values as finite numbers; empty where they are no such list."""
    try:
        numbers = tuple(float(value) for value in values)
    except (TypeError, ValueError):
        return ()
    return numbers if all(map(math.isfinite, numbers)) else ()


def _spaced(values: Any) -> str:
    """A list as it is typed on a command line."""
    if not isinstance(values, tuple | list):
        return repr(values)
    return " ".join(f"{value:g}" if isinstance(value, float) else str(value) for value in values)


@dataclass(frozen=True, kw_only=True)
class SceneConfig(_Checked):
    """How photos and cameras are read."""

    downscale: float = _number(1.0, 1, 100)
    """Divide the photos' width and height by this (2 = half size)."""
    max_side: int = _number(1600, 0, LARGEST)
    """Photos whose longer side has more pixels than this are made smaller, as 3DGS does; 0 takes them as they are."""
    up: tuple[float, float, float] | None = None
    """Direction away from the ground in the scene's frame, for example 0 0 1; found from the scene when not given."""

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.up is None:
            return
        up = _finite(self.up)
        if len(up) != 3 or not any(up):
            raise ConfigError(f"--scene.up is {self.up}; use three finite numbers, not all 0, for example 0 0 1")
        object.__setattr__(self, "up", up)  # JSON gives lists


@dataclass(frozen=True, kw_only=True)
class PhotosConfig(_Checked):
    """How cameras are found for photos that come without a model (structure from motion)."""

    max_side: int = _number(1600, 64, LARGEST)
    """Features are sought in copies of the photos whose longer side has at most this many pixels."""
    max_features: int = _number(8192, 100, LARGEST)
    """Most features kept of a photo."""
    exhaustive_up_to: int = _number(200, 3, LARGEST)
    """Up to this many photos each is compared with each; more are compared with their neighbours in name order."""
    overlap: int = _number(20, 1, LARGEST)
    """How many photos after it each one of a long walk is compared with."""
    upright: bool = True
    """The camera was held the same way up for all photos, as on a walk; switch it off for a drone that looks down."""
    seed: int = _number(0, 0, LARGEST)
    """Seed of every random choice when cameras are found."""


@dataclass(frozen=True, kw_only=True)
class TrainConfig(_Checked):
    """How Gaussians are trained from the photos."""

    steps: int = _number(1200, 1, 10_000_000)
    """Optimiser steps, one photo each."""
    max_gaussians: int = _number(70_000, 1, 100_000_000)
    """Densification stops at this many Gaussians."""
    sh_degree: int = _number(2, 0, 3)
    """Highest degree of the spherical harmonics that carry view-dependent colour (0-3)."""
    holdout_every: int = _number(8, 0, LARGEST)
    """Keep every n-th photo (in name order) out of training to measure quality; 0 trains on all."""
    ssim_weight: float = _number(0.2, 0, 1)
    """Weight of 1 - SSIM in the photometric loss; L1 has the rest."""
    means_rate: float = _number(8e-4, 0, 10)
    """Learning rate of positions at the start, times the scene's extent; it falls to a hundredth."""
    scales_rate: float = _number(3.2e-2, 0, 10)
    """Learning rate of log scales."""
    quats_rate: float = _number(1.6e-2, 0, 10)
    """Learning rate of rotations."""
    opacity_rate: float = _number(0.16, 0, 10)
    """Learning rate of opacity logits."""
    sh_rate: float = _number(8e-3, 0, 10)
    """Learning rate of base colours."""
    sh_rest_rate: float = _number(1.2e-3, 0, 10)
    """Learning rate of the harmonics above the base colour."""
    coarse_until: float = _number(0.6, 0, 1)
    """Share of the steps that are trained on photos of half the width and height."""
    densify: Literal["gradient", "mcmc"] = "gradient"
    """How Gaussians come and go: 'gradient' clones and splits where the photos pull (3DGS), 'mcmc' moves the dead."""
    densify_from: float = _number(0.05, 0, 1)
    """Share of the steps after which Gaussians are cloned and split."""
    densify_until: float = _number(0.5, 0, 1)
    """Share of the steps after which no Gaussian is added any more."""
    densify_every: int = _number(100, 1, LARGEST)
    """Steps between two densifications."""
    densify_gradient: float = _number(4e-4, 0, 1000)
    """Mean absolute gradient of a projected position, in half-images, from which a Gaussian is cloned or split."""
    split_size: float = _number(0.003, 0, math.inf, open=True)
    """Gaussians whose standard deviation exceeds this share of the scene's extent are split, others cloned."""
    prune_opacity: float = _number(0.005, 0, 1)
    """Gaussians fainter than this are removed when densifying."""
    reset_opacity_every: int = _number(0, 0, LARGEST)
    """Steps between two resets of all opacities, which clear floaters in long trainings; 0 for never."""
    drop_unneeded: float = _number(0.0, 0, 1_000_000)
    """Remove, when densification ends, what no photo shows with more than this many pixels' weight; 0 keeps all."""
    pair_alpha: float = _number(1.0, 1, 255)
    """The paper's τ in 1/255: a Gaussian is drawn in a tile only where its opacity there reaches it; 1 is exact."""
    literal_pairs: bool = False
    """Draw a Gaussian only in the tile of its centre, as the paper prints its eq. 3; for comparisons."""
    antialiased: bool = False
    """Fade Gaussians smaller than a pixel instead of widening them (Mip-Splatting)."""
    exposure: bool = False
    """Learn an affine change of colour for every photo, for light and white balance that vary."""
    refine_poses: bool = False
    """Move the cameras along with the Gaussians, for poses that the photos disagree with; those kept aside stay."""
    forgive: float = _number(0.0, 0, 0.9)
    """Share of each photo's pixels that are left out because they differ most, for leaves that moved."""
    opacity_weight: float = _number(0.0, 0, 10)
    """Weight of the mean opacity in the loss; clears haze."""
    scale_weight: float = _number(0.0, 0, 10)
    """Weight of the mean size in the loss, in the scene's extent."""
    flatness_weight: float = _number(0.0, 0, 10)
    """Weight of the mean thickness in the loss, in the scene's extent; flat Gaussians make better surfaces."""
    load_weight: float = _number(0.0, 0, 0.99)
    """Share of the loss that evens out how many Gaussians pixels blend (the paper's eq. 4; AdR-Gaussian has 0.41)."""
    check_every: int = _number(0, 0, LARGEST)
    """Steps between two measurements of the photos kept aside; 0 measures at the end only."""
    patience: int = _number(0, 0, LARGEST)
    """Stop when this many measurements in a row brought no 0.02 dB; 0 never stops early."""
    checkpoint_every: int = _number(500, 1, LARGEST)
    """Steps between two checkpoints."""
    seed: int = _number(0, 0, LARGEST)
    """Seed of every random choice in training."""


Preset = Literal["quick", "standard", "paper"]
PRESETS: dict[Preset, TrainConfig] = {
    "quick": TrainConfig(steps=400, max_gaussians=40_000, coarse_until=0.7),
    "standard": TrainConfig(),
    "paper": TrainConfig(
        steps=30_000,
        max_gaussians=200_000,
        sh_degree=3,
        coarse_until=0.0,
        means_rate=1.6e-3,
        scales_rate=5e-3,
        quats_rate=1e-3,
        opacity_rate=5e-2,
        sh_rate=2.5e-3,
        sh_rest_rate=1.25e-4,
        densify_from=0.016,
        densify_until=0.5,
        split_size=0.01,
        reset_opacity_every=3000,
    ),
}
"""Settings of training by name: a first look, the default, and the paper's 30,000 steps (its position rate of 1.6e-3,
decaying, and harmonics of degree 3; what it leaves open as in 3DGS)."""


@dataclass(frozen=True, kw_only=True)
class EmbedConfig(_Checked):
    """How Gaussians get features that words can query."""

    encoder: Literal["embedded", "clip"] = "embedded"
    """Image and text encoder: 'embedded' ships with the package and knows fruit; 'clip' answers any word."""
    clip: str = _path("openai/clip-vit-base-patch16", "folder")
    """CLIP or SigLIP checkpoint for encoder 'clip': a local folder or a name on the Hugging Face hub."""
    masks: Literal["classical", "sam"] = "classical"
    """What encoder 'clip' looks at one by one: 'classical' needs no download, 'sam' finds better masks."""
    sam: str = _path("facebook/sam-vit-huge", "folder")
    """SAM checkpoint for masks 'sam': a local folder or a name on the Hugging Face hub."""
    allow_download: bool = False
    """Download a checkpoint that is not on this computer from the Hugging Face hub."""
    features: Literal["lift", "joint"] = "lift"
    """Masks' features in full, averaged into trained Gaussians ('lift'), or the paper's short codes, trained along."""
    rounds: int = _number(0, 0, 100)
    """Times that views which disagree about a Gaussian are given less weight when masks' features are lifted."""
    code_epochs: int = _number(100, 1, 100_000)
    """How often the autoencoder of the codes sees every mask's feature."""
    code_batch: int = _number(64, 1, 1_000_000)
    """Features in one step of the autoencoder."""
    code_rate: float = _number(7e-4, 0, 10, open=True)
    """Learning rate of the autoencoder."""
    code_each_level: bool = False
    """Train one autoencoder a level of masks instead of one for all."""
    semantic_rate: float = _number(0.02, 0, 10, open=True)
    """Learning rate of the Gaussians' codes in joint training."""
    semantic_after: float = _number(0.3, 0, 0.99)
    """Share of the training's steps after which codes are trained."""
    semantic_weight: float = _number(0.1, 0, 1000, open=True)
    """Weight of the semantic loss beside the photometric one (the paper's λ_sem); matters where it moves Gaussians."""
    semantic_moves: bool = False
    """Let the semantic loss move, reshape and fade Gaussians too (the paper); else it trains their codes alone."""
    seed: int = _number(0, 0, LARGEST)
    """Seed of every random choice when features are made."""


@dataclass(frozen=True, kw_only=True)
class CountConfig(_Checked):
    """How fruit are selected and counted."""

    threshold: float = _number(0.5, 0, 1, open=True)
    """Lowest probability at which a Gaussian belongs to the prompt."""
    method: Literal["voting", "template", "fruitnerf"] = "voting"
    """'voting': centre votes, sphere fits, a gate; 'template': the paper's templates; 'fruitnerf': FruitNeRF's."""
    template: str = _path("", "file")
    """Mesh or point cloud of one fruit, for the methods 'template' and 'fruitnerf'; without it the scene or a ball."""
    select: Literal["calibrated", "dual"] = "calibrated"
    """'calibrated': by the probability of the prompt; 'dual': by the paper's two thresholds on cosines (eq. 11)."""
    tau_pos: float = _number(0.25, 0, 1)
    """With 'dual', a Gaussian's largest cosine to what is counted must exceed this (the paper's τ_pos)."""
    tau_neg: float = _number(0.25, 0, 1)
    """With 'dual', a Gaussian's largest cosine to the negatives must stay below this (the paper's τ_neg)."""
    neighbours: int = _number(0, 0, 1000)
    """Average probabilities over each Gaussian and this many nearest ones; 0 leaves them as they are."""
    diameter: float | None = _number(None, 0, math.inf, open=True)
    """Mean fruit diameter in scene units; estimated from the scene when not given."""
    sample_budget: int = _number(500_000, 100, 100_000_000)
    """Most points sampled from the selected Gaussians; fewer where fruit are told apart with fewer."""
    box: tuple[float, float, float, float, float, float] | None = None
    """Count in this box only: two opposite corners x y z x y z in the scene's frame."""
    polygon: tuple[float, ...] | None = None
    """Count in this outline only, at any height: three or more corners x y z x y z … in the scene's frame, in order."""
    heights: tuple[float, float] | None = None
    """With an outline, count between these two heights only: distances along up from the frame's origin."""
    trees: int = _number(0, 0, 10_000)
    """Trees of the row that fruit are shared out among; 0 asks for no counts by tree."""
    tree_places: tuple[float, ...] | None = None
    """Where the trees of the row stand, x y z x y z … in the scene's frame; found from the fruit when not given."""
    seed: int = _number(0, 0, LARGEST)
    """Seed of every random choice in counting."""

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.template and self.method == "voting":
            raise ConfigError("--count.template is for --count.method template or fruitnerf; voting needs no template")
        self._check_places("box", lambda n: n == 2, "two opposite corners, x y z x y z")
        self._check_places("polygon", lambda n: n >= 3, "three or more corners, x y z each")
        self._check_places("tree_places", lambda n: n >= 1, "x y z of each tree")
        if self.box is not None and self.polygon is not None:
            raise ConfigError("--count.box and --count.polygon are both given; use one of them")
        if self.box is not None and any(self.box[axis] == self.box[axis + 3] for axis in range(3)):
            raise ConfigError(f"--count.box {_spaced(self.box)} has no volume; its corners must differ in x, y and z")
        self._check_heights()
        if self.tree_places is None:
            return
        places = {self.tree_places[start : start + 3] for start in range(0, len(self.tree_places), 3)}
        if 3 * len(places) < len(self.tree_places):
            raise ConfigError("--count.tree-places names one place twice; give every tree a place of its own")
        if self.trees not in (0, len(places)):
            raise ConfigError(
                f"--count.trees is {self.trees} and --count.tree-places has {len(places)} trees; leave one of them out"
            )

    def _check_heights(self) -> None:
        """Make the heights a pair of finite numbers, the lower one first."""
        if self.heights is None:
            return
        heights = _finite(self.heights)
        if len(heights) != 2 or heights[0] == heights[1]:
            raise ConfigError(f"--count.heights is {_spaced(self.heights)}; use two different finite numbers")
        if self.polygon is None:
            raise ConfigError("--count.heights is given without --count.polygon, the outline that it belongs to")
        object.__setattr__(self, "heights", (min(heights), max(heights)))

    def _check_places(self, name: str, enough: Callable[[int], bool], expected: str) -> None:
        """Make the setting a tuple of finite numbers, three a place."""
        given = getattr(self, name)
        if given is None:
            return
        numbers = _finite(given)
        if len(numbers) % 3 or not enough(len(numbers) // 3):
            flag = f"--count.{name.replace('_', '-')}"
            raise ConfigError(f"{flag} is {_spaced(given)}; use {expected}, all finite numbers in the scene's frame")
        object.__setattr__(self, name, numbers)  # JSON gives lists, Blender text


@dataclass(frozen=True, kw_only=True)
class UnitsConfig(_Checked):
    """How long a scene unit is: a known length of one thing, else by the photos' GPS tags."""

    length: float | None = _number(None, 0, math.inf, open=True)
    """A known length in metres; say of what by points, cameras or object."""
    points: tuple[float, float, float, float, float, float] | None = None
    """The length lies between these two points, x y z x y z in the scene's frame."""
    cameras: tuple[str, str] | None = None
    """The length lies between the places where these two photos were taken; their names."""
    object: str | None = None
    """The length is the longest side of the largest crate, ladder, … that this word names; seen whole."""
    metres_per_unit: float | None = _number(None, 0, math.inf, open=True)
    """Metres in a scene unit, where they are known outright."""
    gps: bool = True
    """Where no length is given, find the scale by the GPS tags of the photos if they agree with their cameras."""

    def __post_init__(self) -> None:
        super().__post_init__()
        for name in ("points", "cameras"):
            if isinstance(getattr(self, name), list):  # JSON's
                object.__setattr__(self, name, tuple(getattr(self, name)))
        measured = [name for name in ("points", "cameras", "object") if getattr(self, name) is not None]
        if self.metres_per_unit is not None and (measured or self.length is not None):
            raise ConfigError("--units.metres-per-unit says all; leave out --units.length and what it is of")
        if len(measured) > 1:
            raise ConfigError(f"--units.{measured[0]} and --units.{measured[1]} are two things to measure; keep one")
        if measured and self.length is None:
            raise ConfigError(f"--units.{measured[0]} has no length; give it in metres by --units.length")
        if self.length is not None and not measured:
            raise ConfigError(
                f"--units.length is {self.length} m of nothing; say of what by --units.points, --units.cameras or "
                "--units.object"
            )
        self._check_points()
        if self.cameras is not None and (len(self.cameras) != 2 or self.cameras[0] == self.cameras[1]):
            raise ConfigError(f"--units.cameras is {', '.join(self.cameras)}; name two photos")
        if self.object is not None and not self.object.strip():
            raise ConfigError("--units.object is empty; name the thing that was measured, for example bucket")

    def _check_points(self) -> None:
        if self.points is None:
            return
        if len(self.points) != 6 or not all(map(math.isfinite, self.points)):
            raise ConfigError(
                f"--units.points is {self.points}; use six finite numbers, x y z of one point and another"
            )
        if self.points[:3] == self.points[3:]:
            raise ConfigError(f"--units.points names the point {self.points[:3]} twice; name two points")


@dataclass(frozen=True, kw_only=True)
class Config:
    """Every stage's settings: what a run needs beside its scene and its prompt."""

    scene: SceneConfig = field(default_factory=SceneConfig)
    """Photos and cameras."""
    photos: PhotosConfig = field(default_factory=PhotosConfig)
    """Cameras from photos alone."""
    train: TrainConfig = field(default_factory=TrainConfig)
    """Gaussians."""
    embed: EmbedConfig = field(default_factory=EmbedConfig)
    """Features and words."""
    count: CountConfig = field(default_factory=CountConfig)
    """Fruit."""
    units: UnitsConfig = field(default_factory=UnitsConfig)
    """Scale."""

    @classmethod
    def from_document(cls, document: Mapping[str, Any]) -> Config:
        """The config that `dataclasses.asdict` turned into `document`.

        Raises:
            ConfigError: it was written by another version with other settings.
        """
        stages = {
            "scene": SceneConfig,
            "photos": PhotosConfig,
            "train": TrainConfig,
            "embed": EmbedConfig,
            "count": CountConfig,
            "units": UnitsConfig,
        }
        document = {"units": {}, **document}  # results of before there were units
        try:
            return cls(**{name: stage(**document[name]) for name, stage in stages.items()})
        except (KeyError, TypeError) as error:
            raise ConfigError(
                f"stored settings are of another version ({error}); count again from the photos"
            ) from error
