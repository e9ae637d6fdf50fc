"""What is measured for the documents: scenes, stages and methods."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass

from ...engine.config import Preset
from ..ladder.stages import END_TO_END, STAGES, TRUE_POSES
from ..two_photos import TWO_PHOTOS
from .records import Record, Trial

SPECIES = ("apple", "plum", "lemon", "pear", "peach", "mango", "cherry", "orange")
SEEDS = (101, 102, 103)
WHOLE = {
    "apple": 402, "plum": 413, "cherry": 402, "pear": 412, "mango": 411, "peach": 414, "lemon": 410, "orange": 413
}  # fmt: skip
"""{species: seed} of whole trees: they bear from .5 to 1.5 times the usual fruit. plum-whole:402 is for fitting."""
LOADED = ("apple", "plum", "orange", "pear")
"""Species whose trees bear from half to one and a half times the usual fruit."""
LOAD_SEEDS = (304, 305, 302, 301, 303)
"""Seeds of such trees: five consecutive ones span the whole range; those that bear most and least come first."""
CONDITIONS: Mapping[str, str] = {
    "": "as usual: spindle, red, 60 photos",
    "wall": "limbs in the plane of the row",
    "vase": "open centre",
    "bush": "several low stems",
    "clumped": "fruit in clumps of five",
    "mixed-sizes": "sizes vary by a third",
    "heavy-load": "half as many fruit again",
    "leafy": "twice the leaves",
    "neighbours": "rows with fruit behind and in front",
    "green": "green fruit",
    "bicoloured": "green fruit with a red cheek",
    "distractors": "tags, flowers, buckets, crates",
    "fallen": "fruit on the ground",
    "hard-light": "hard light",
    "exposure": "exposure and colour drift",
    "motion-blur": "photos blurred by 3 pixels",
    "wind": "leaves turn by 15°",
    "pose-noise": "cameras wrong by 0.25°",
    "half-ring": "seen from one side",
    "few-views": "15 photos",
    "low-resolution": "fruit of 9 pixels",
}
"""{ending of a preset of apple-small: the condition in words}."""


@dataclass(frozen=True, kw_only=True)
class Study:
    """Trials that belong together: every scene (a preset with a seed) in every stage by every method. training: preset
    of the training settings."""

    scenes: tuple[str, ...]
    stages: tuple[str, ...]
    methods: tuple[str, ...] = ("voting",)
    training: Preset = "standard"

    @property
    def trials(self) -> list[Trial]:
        """In the order in which they are measured."""
        return [
            Trial(scene=scene.replace(":", "-"), stage=stage, method=method)
            for scene in self.scenes
            for method in self.methods
            for stage in self.stages
        ]


STUDIES: Mapping[str, Study] = {
    "whole": Study(
        scenes=tuple(f"{species}-whole:{seed}" for species, seed in WHOLE.items()),
        stages=(TRUE_POSES, END_TO_END),
    ),
    "known-cameras": Study(
        scenes=tuple(f"{species}-small:{seed}" for seed in SEEDS[1:] for species in SPECIES), stages=(TRUE_POSES,)
    ),
    "ladder": Study(
        scenes=tuple(f"{species}-small:{seed}" for seed in SEEDS for species in SPECIES), stages=tuple(STAGES)
    ),
    "phone": Study(
        scenes=tuple(f"{species}-phone:101" for species in ("apple", "mango", "cherry")),
        stages=(TRUE_POSES, END_TO_END),
    ),
    "conditions": Study(
        scenes=tuple("-".join(filter(None, ("apple-small", name))) + ":101" for name in CONDITIONS),
        stages=(TRUE_POSES,),
    ),
    "methods": Study(
        scenes=tuple(f"{species}-small:101" for species in SPECIES),
        stages=(TRUE_POSES,),
        methods=("voting", "template", "fruitnerf"),
    ),
    "two-photos": Study(
        scenes=tuple(f"{species}-load:{seed}" for seed in LOAD_SEEDS for species in LOADED),
        stages=(TRUE_POSES,),
        methods=("voting", TWO_PHOTOS),
        training="quick",
    ),
}
"""{name: study}, the most important first."""


def training_of(trial: Trial) -> Preset:
    """The preset of the training settings of a trial; all trials of a scene share it."""
    return next((study.training for study in STUDIES.values() if trial in study.trials), "standard")


def select_study(name: str, records: Iterable[Record]) -> dict[Trial, Record]:
    """Select the records of a study, in its order: those of the present code or, if there are none, those of earlier
    code. A table never compares rows of different code."""
    by_trial = {record.trial: record for record in records}
    own = {trial: by_trial[trial] for trial in STUDIES[name].trials if trial in by_trial}
    return {trial: record for trial, record in own.items() if not record.stale} or own
