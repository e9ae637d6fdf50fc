"""The settings of every stage: declared once, shown as flags, as Blender properties and in the docs.

The string below a field is the help text of the flag and the tooltip of the property.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, fields
from functools import cache
from numbers import Integral, Real
from typing import Any, Literal, get_args, get_origin, get_type_hints

from .errors import ConfigError
from .setting import LARGEST, number, option, path, range_of


class _Checked:
    """Settings whose kinds, choices and ranges are checked when they are created."""

    def __post_init__(self) -> None:
        kinds = _kinds(type(self))
        for setting in fields(self):  # type: ignore[arg-type]
            value, allowed = getattr(self, setting.name), range_of(setting)
            if value is None and setting.default is None:
                continue
            wrong = _wrong_kind(value, kinds[setting.name])
            if not wrong and allowed is not None and value not in allowed:
                wrong = f"Use {allowed}."
            if wrong:
                flag = f"--{type(self).__name__.removesuffix('Config').lower()}.{setting.name.replace('_', '-')}"
                raise ConfigError(f"{flag} is {value}. {wrong}")


_kinds: Callable[[type], dict[str, Any]] = cache(get_type_hints)
"""{field: its type} of a class, resolved once: a manifest of 10,000 trees makes as many settings."""


def _wrong_kind(value: Any, kind: Any) -> str:
    """What to use instead of a value that is not of this type; empty if it is, or if the type is not checked."""
    if get_origin(kind) is Literal:
        return "" if value in get_args(kind) else f"Use {' or '.join(get_args(kind))}."
    if kind is bool:
        return "" if isinstance(value, bool) else "Use true or false."
    if kind is int and (isinstance(value, bool) or not isinstance(value, Integral)):
        return "Use a whole number."
    if kind in (float, float | None) and (isinstance(value, bool) or not isinstance(value, Real)):
        return "Use a number."
    return "Use a text." if kind is str and not isinstance(value, str) else ""


def _to_finite(values: Any) -> tuple[float, ...]:
    """Return the values as finite numbers; empty if they are not a list of finite numbers."""
    try:
        numbers = tuple(float(value) for value in values)
    except (TypeError, ValueError):
        return ()
    return numbers if all(map(math.isfinite, numbers)) else ()


def _format_list(values: Any) -> str:
    """Write a list as typed on a command line."""
    if not isinstance(values, tuple | list):
        return repr(values)
    return " ".join(f"{value:g}" if isinstance(value, float) else str(value) for value in values)


@dataclass(frozen=True, kw_only=True)
class SceneConfig(_Checked):
    """How photos and cameras are read."""

    downscale: float = number(1.0, 1, 100)
    """Divide the photos' width and height by this (2 = half size)."""
    max_side: int = number(1600, 0, LARGEST)
    """Scale down photos whose longer side has more pixels than this; 0 keeps the full size. If not given, photos with
    narrow fruit are read larger."""
    up: tuple[float, float, float] | None = None
    """Direction away from the ground in the scene frame, for example 0 0 1; estimated if not given."""
    sections: int = number(0, 0, 1000)
    """Parts in which a long capture of a row is trained; 0 chooses by the number of photos, 1 trains all at once."""

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.up is None:
            return
        up = _to_finite(self.up)
        if len(up) != 3 or not any(up):
            raise ConfigError(f"--scene.up is {self.up}. Use three finite numbers, not all 0, for example 0 0 1.")
        object.__setattr__(self, "up", up)  # JSON gives lists


@dataclass(frozen=True, kw_only=True)
class PhotosConfig(_Checked):
    """How cameras are found for photos without a camera model (structure from motion)."""

    max_side: int = number(1600, 64, LARGEST)
    """Detect features in copies of the photos whose longer side has at most this many pixels."""
    exhaustive_up_to: int = number(40, 3, LARGEST)
    """Match all pairs up to this many photos; above it, only neighbours in name order and photos of similar content."""
    overlap: int = number(10, 1, LARGEST)
    """Number of following photos that each photo is matched with, above that limit."""
    upright: bool = True
    """The camera was held the same way up for all photos; switch off for a drone that looks straight down."""
    seed: int = number(0, 0, LARGEST)
    """Random seed of the camera search."""


@dataclass(frozen=True, kw_only=True)
class TrainConfig(_Checked):
    """How Gaussians are trained from the photos."""

    steps: int = number(1200, 1, 10_000_000, level="common")
    """Number of optimiser steps; each step uses one photo."""
    max_gaussians: int = number(70_000, 1, 100_000_000)
    """Stop densification at this number of Gaussians."""
    grow: bool = True
    """If the two numbers above are those of a preset, use more for more than 60 photos, or for larger than 480×360."""
    sh_degree: int = number(2, 0, 3)
    """Degree of the spherical harmonics for view-dependent colour (0 to 3)."""
    holdout_every: int = number(8, 0, LARGEST)
    """Hold out every n-th photo, in name order, to measure quality; 0 trains on all photos."""
    means_rate: float = number(8e-4, 0, 10)
    """Initial learning rate of positions, times the scene extent; it decays to a hundredth."""
    scales_rate: float = number(3.2e-2, 0, 10)
    """Learning rate of log scales."""
    quats_rate: float = number(1.6e-2, 0, 10)
    """Learning rate of rotations."""
    opacity_rate: float = number(0.16, 0, 10)
    """Learning rate of opacity logits."""
    sh_rate: float = number(8e-3, 0, 10)
    """Learning rate of base colours."""
    sh_rest_rate: float = number(1.2e-3, 0, 10)
    """Learning rate of the higher spherical harmonics."""
    coarse_until: float = number(0.6, 0, 1)
    """Share of the steps that train on photos of half the width and height."""
    densify: Literal["gradient", "mcmc"] = option("gradient", level="experimental")
    """Densification: 'gradient' clones and splits by image gradient (3DGS), 'mcmc' relocates dead Gaussians."""
    densify_from: float = number(0.05, 0, 1)
    """Share of the steps before densification starts."""
    densify_until: float = number(0.5, 0, 1)
    """Share of the steps after which densification stops."""
    densify_every: int = number(100, 1, LARGEST)
    """Steps between two densifications."""
    split_size: float = number(0.003, 0, math.inf, open=True)
    """Split Gaussians whose standard deviation exceeds this share of the scene extent; clone the others."""
    reset_opacity_every: int = number(0, 0, LARGEST)
    """Steps between two resets of all opacities, which remove floaters in long trainings; 0 never resets."""
    drop_unneeded: float = number(0.0, 0, 1_000_000, level="experimental")
    """When densification ends, remove Gaussians with less weight than this in every photo, in pixels; 0 keeps all."""
    pair_alpha: float = number(1.0, 1, 255, level="experimental")
    """Least opacity, in 1/255, at which a Gaussian is drawn in a tile (the paper's τ); 1 is exact."""
    literal_pairs: bool = option(False, level="experimental")
    """Draw each Gaussian only in the tile of its centre, as the paper prints its eq. 3; for comparison."""
    antialiased: bool = False
    """Fade Gaussians smaller than a pixel instead of widening them (Mip-Splatting)."""
    exposure: bool = False
    """Learn an affine colour change per photo, for varying light and white balance."""
    refine_poses: bool = option(False, level="experimental")
    """Optimise the camera poses of the training photos; turns exact cameras by 0.2° and can lower the count."""
    forgive: float = number(0.0, 0, 0.9)
    """Share of each photo's pixels to ignore where the error is largest, for moving leaves."""
    opacity_weight: float = number(0.0, 0, 10, level="experimental")
    """Weight of the mean opacity in the loss; reduces haze."""
    scale_weight: float = number(0.0, 0, 10, level="experimental")
    """Weight of the mean scale in the loss, relative to the scene extent."""
    flatness_weight: float = number(0.0, 0, 10, level="experimental")
    """Weight of the mean thickness in the loss, relative to the scene extent; favours flat Gaussians."""
    load_weight: float = number(0.0, 0, 0.99, level="experimental")
    """Share of the loss that evens out the Gaussians per pixel (the paper's eq. 4; AdR-Gaussian uses 0.41)."""
    check_every: int = number(0, 0, LARGEST)
    """Steps between two measurements of the held-out photos; 0 measures at the end only."""
    patience: int = number(0, 0, LARGEST)
    """Stop when this many measurements in a row gain less than 0.02 dB; 0 never stops early."""
    checkpoint_every: int = number(500, 1, LARGEST)
    """Steps between two checkpoints."""
    device: str = "auto"
    """What trains: 'auto' takes a graphics card if one can be used; 'cpu', 'gpu', or a part of the card's name."""
    seed: int = number(0, 0, LARGEST)
    """Random seed of training."""


Preset = Literal["quick", "standard", "paper"]
PRESETS: dict[Preset, TrainConfig] = {
    "quick": TrainConfig(steps=400, max_gaussians=40_000, coarse_until=0.7),
    "standard": TrainConfig(),
    "paper": TrainConfig(
        steps=30_000,
        max_gaussians=200_000,
        grow=False,
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
"""Training settings by name: a quick preview, the default, and the paper's 30,000 steps (its decaying position rate of
1.6e-3 and harmonics of degree 3; everything it does not state as in 3DGS)."""


@dataclass(frozen=True, kw_only=True)
class EmbedConfig(_Checked):
    """How Gaussians get features that words can query."""

    encoder: Literal["embedded", "clip"] = option("embedded", level="common")
    """Encoder of photos and words: 'embedded' is built in and knows fruit; 'clip' accepts any word."""
    clip: str = path("openai/clip-vit-base-patch16", "folder")
    """CLIP or SigLIP checkpoint of encoder clip: a local folder or a name on the Hugging Face hub."""
    masks: Literal["classical", "sam"] = "classical"
    """Masks that encoder clip crops: 'classical' needs no download, 'sam' is more accurate."""
    sam: str = path("facebook/sam-vit-huge", "folder")
    """SAM checkpoint of masks sam: a local folder or a name on the Hugging Face hub."""
    allow_download: bool = False
    """Allow the download of a missing checkpoint from the Hugging Face hub."""
    words: str = path("", "folder")
    """Folder of taught words (.fruitword); if not given, the user's own."""
    features: Literal["lift", "joint"] = option("lift", level="experimental")
    """Features of masks: 'lift' averages full features into the Gaussians, 'joint' trains the paper's short codes."""
    rounds: int = number(0, 0, 100, level="experimental")
    """Rounds in which views that disagree about a Gaussian get less weight when mask features are lifted."""
    code_epochs: int = number(100, 1, 100_000, level="experimental")
    """Training epochs of the autoencoder of the codes."""
    code_each_level: bool = option(False, level="experimental")
    """Train one autoencoder per mask level instead of one for all levels."""
    semantic_after: float = number(0.3, 0, 0.99, level="experimental")
    """Share of the training steps after which codes are trained."""
    semantic_moves: bool = option(False, level="experimental")
    """Let the semantic loss also change position, shape and opacity (the paper); else it trains codes only."""
    seed: int = number(0, 0, LARGEST)
    """Random seed of the features."""


@dataclass(frozen=True, kw_only=True)
class CountConfig(_Checked):
    """How fruit are selected and counted."""

    threshold: float = number(0.5, 0, 1, open=True, level="common")
    """Least probability at which a Gaussian matches the prompt."""
    method: Literal["voting", "template", "fruitnerf"] = option("voting", level="experimental")
    """Counting method: 'voting' fits spheres, 'template' is the paper's method, 'fruitnerf' is FruitNeRF's."""
    template: str = path("", "file", level="experimental")
    """Mesh or point cloud of one fruit, for template and fruitnerf; estimated from the scene if not given."""
    select: Literal["calibrated", "dual"] = option("calibrated", level="experimental")
    """Selection: 'calibrated' by probability, 'dual' by the paper's two cosine thresholds (eq. 11)."""
    tau_pos: float = number(0.25, 0, 1, level="experimental")
    """With dual: least cosine to the prompt (the paper's τ_pos)."""
    tau_neg: float = number(0.25, 0, 1, level="experimental")
    """With dual: largest cosine to the negatives (the paper's τ_neg)."""
    neighbours: int = number(0, 0, 1000, level="experimental")
    """Average the probability of each Gaussian with this many nearest Gaussians; 0 switches it off."""
    diameter: float | None = number(None, 0, math.inf, open=True)
    """Mean fruit diameter in scene units; estimated from the scene if not given."""
    sample_budget: int = number(500_000, 100, 100_000_000)
    """Maximum number of points sampled from the selected Gaussians."""
    box: tuple[float, float, float, float, float, float] | None = option(None, level="common")
    """Count in this box only: two opposite corners x y z x y z in the scene frame."""
    polygon: tuple[float, ...] | None = None
    """Count inside this outline only: three or more corners x y z in order, in the scene frame; any height."""
    heights: tuple[float, float] | None = None
    """With polygon: count between these two heights only, measured along up from the origin of the frame."""
    trees: int = number(0, 0, 10_000, level="common")
    """Number of trees in the row to report separate counts for; 0 reports no counts per tree."""
    tree_places: tuple[float, ...] | None = None
    """Positions of the trees of the row, x y z each, in the scene frame; estimated from the fruit if not given."""
    seed: int = number(0, 0, LARGEST)
    """Random seed of counting."""

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.template and self.method == "voting":
            raise ConfigError("--count.template needs --count.method template or fruitnerf. Leave it out with voting.")
        self._check_places("box", lambda n: n == 2, "two opposite corners, x y z x y z")
        self._check_places("polygon", lambda n: n >= 3, "three or more corners, x y z each")
        self._check_places("tree_places", lambda n: n >= 1, "x y z of each tree")
        if self.box is not None and self.polygon is not None:
            raise ConfigError("--count.box and --count.polygon are both given. Use one of them.")
        if self.box is not None and any(self.box[axis] == self.box[axis + 3] for axis in range(3)):
            raise ConfigError(
                f"--count.box {_format_list(self.box)} has no volume. Its corners must differ in x, y and z."
            )
        self._check_heights()
        if self.tree_places is None:
            return
        places = {self.tree_places[start : start + 3] for start in range(0, len(self.tree_places), 3)}
        if 3 * len(places) < len(self.tree_places):
            raise ConfigError("--count.tree-places has the same position twice. Give every tree its own position.")
        if self.trees not in (0, len(places)):
            raise ConfigError(
                f"--count.trees is {self.trees} and --count.tree-places has {len(places)} trees. Leave one of them out."
            )

    def _check_heights(self) -> None:
        """Make the heights a pair of finite numbers in ascending order."""
        if self.heights is None:
            return
        heights = _to_finite(self.heights)
        if len(heights) != 2 or heights[0] == heights[1]:
            raise ConfigError(f"--count.heights is {_format_list(self.heights)}. Use two different finite numbers.")
        if self.polygon is None:
            raise ConfigError("--count.heights needs --count.polygon. Give the outline too.")
        object.__setattr__(self, "heights", (min(heights), max(heights)))

    def _check_places(self, name: str, enough: Callable[[int], bool], expected: str) -> None:
        """Make the setting a tuple of finite numbers, three per position."""
        given = getattr(self, name)
        if given is None:
            return
        numbers = _to_finite(given)
        if len(numbers) % 3 or not enough(len(numbers) // 3):
            flag = f"--count.{name.replace('_', '-')}"
            raise ConfigError(
                f"{flag} is {_format_list(given)}. Use {expected}, all finite numbers in the scene frame."
            )
        object.__setattr__(self, name, numbers)  # JSON gives lists, Blender text


@dataclass(frozen=True, kw_only=True)
class UnitsConfig(_Checked):
    """How long a scene unit is: from a known length, else from the GPS tags of the photos."""

    length: float | None = number(None, 0, math.inf, open=True, level="common")
    """A known length in metres; give what it measures with points, cameras or object."""
    points: tuple[float, float, float, float, float, float] | None = None
    """The known length is the distance between these two points, x y z x y z in the scene frame."""
    cameras: tuple[str, str] | None = option(None, level="common")
    """The known length is the distance between the cameras of these two photos; give their names."""
    object: str | None = option(None, level="common")
    """The known length is the longest side of the largest object of this word, for example crate or ladder."""
    metres_per_unit: float | None = number(None, 0, math.inf, open=True)
    """Metres per scene unit, if known."""
    gps: bool = True
    """Without a known length, estimate the scale from the GPS tags of the photos if they agree with the cameras."""

    def __post_init__(self) -> None:
        super().__post_init__()
        for name in ("points", "cameras"):
            if isinstance(getattr(self, name), list):  # JSON's
                object.__setattr__(self, name, tuple(getattr(self, name)))
        measured = [name for name in ("points", "cameras", "object") if getattr(self, name) is not None]
        if self.metres_per_unit is not None and (measured or self.length is not None):
            raise ConfigError("--units.metres-per-unit and a known length are both given. Use one of them.")
        if len(measured) > 1:
            raise ConfigError(f"--units.{measured[0]} and --units.{measured[1]} are both given. Use one of them.")
        if measured and self.length is None:
            raise ConfigError(f"--units.{measured[0]} has no length. Give it in metres with --units.length.")
        if self.length is not None and not measured:
            raise ConfigError(
                f"--units.length is {self.length} m, but what it measures is missing. Add --units.points, "
                "--units.cameras or --units.object."
            )
        self._check_points()
        if self.cameras is not None and (len(self.cameras) != 2 or self.cameras[0] == self.cameras[1]):
            raise ConfigError(f"--units.cameras is {', '.join(self.cameras)}. Give the names of two photos.")
        if self.object is not None and not self.object.strip():
            raise ConfigError("--units.object is empty. Give the object that was measured, for example bucket.")

    def _check_points(self) -> None:
        if self.points is None:
            return
        if len(self.points) != 6 or not all(map(math.isfinite, self.points)):
            raise ConfigError(
                f"--units.points is {self.points}. Use six finite numbers: x y z of one point, then of the other."
            )
        if self.points[:3] == self.points[3:]:
            raise ConfigError(f"--units.points names the point {self.points[:3]} twice. Give two different points.")


@dataclass(frozen=True, kw_only=True)
class Config:
    """The settings of every stage: what a run needs in addition to its scene and its prompt."""

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
            ConfigError: another version with other settings wrote it.
        """
        document = {"units": {}, **document}  # results from before there were units
        try:
            return cls(**{name: stage(**_drop_removed(name, document[name])) for name, stage in STAGES.items()})
        except (KeyError, TypeError) as error:
            raise ConfigError(
                f"The stored settings are from another version ({error}). Count again from the photos."
            ) from error

    def list_changed(self) -> frozenset[str]:
        """List the settings that are not at their default, as "stage.setting"."""
        return frozenset(
            f"{stage}.{each.name}"
            for stage, usual in STAGES.items()
            for each in fields(usual)
            if getattr(getattr(self, stage), each.name) != each.default
        )


STAGES: dict[str, Any] = {stage.name: stage.default_factory for stage in fields(Config)}
"""{stage: class of its settings}, in the order of the stages."""
WITHOUT_EFFECT: dict[type, tuple[str, ...]] = {
    TrainConfig: ("checkpoint_every", "device"),
    EmbedConfig: ("clip", "sam", "allow_download", "words"),
}
"""{settings: names} of those that do not change a result: paths, which differ between computers, and checkpoints; the
device only rounds differently, and keys hold its name."""
REMOVED: dict[str, dict[str, float]] = {
    "photos": {"max_features": 8192},
    "train": {"ssim_weight": 0.2, "densify_gradient": 4e-4, "prune_opacity": 0.005},
    "embed": {"code_batch": 64, "code_rate": 7e-4, "semantic_rate": 0.02, "semantic_weight": 0.1},
}
"""{stage: {setting: value}} of settings of version 0.1 that are constants now; its results still hold them."""


def list_ineffective(settings: _Checked) -> tuple[str, ...]:
    """List the names of those settings of a stage that do not change a result."""
    return WITHOUT_EFFECT.get(type(settings), ())


def select_decisive(settings: _Checked) -> dict[str, Any]:
    """Select the settings of a stage that change a result: equal ones give equal results."""
    unused = list_ineffective(settings)
    return {each.name: getattr(settings, each.name) for each in fields(settings) if each.name not in unused}  # type: ignore[arg-type]


def _drop_removed(stage: str, stored: Mapping[str, Any]) -> dict[str, Any]:
    """Return a stage's stored settings without those that are constants now.

    Raises:
        ConfigError: a removed setting was not at its default.
    """
    removed = REMOVED.get(stage, {})
    for name, value in removed.items():
        if stored.get(name, value) != value:
            flag = f"--{stage}.{name.replace('_', '-')}"
            raise ConfigError(
                f"The result was made with {flag} {stored[name]}, a removed setting. Count again from the photos."
            )
    return {name: value for name, value in stored.items() if name not in removed}
