"""Crowns to compare methods on: simulated ones, and those of generated scenes with true masks."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path

from ...engine.config import Config
from ...engine.errors import FormatError
from ...engine.evaluation.renders import DEPTH, INSTANCES
from ...engine.evaluation.truth import Truth, read_truth, read_views, true_labels
from ...engine.scene.source import Source
from ...engine.storage.files import file_hash, files_hash
from ...engine.storage.keys import stage_key
from ..ladder.stages import LadderStages
from ..orchards import TRUTH, read_origin
from .baselines import Found, Surface, surface_of
from .simulated import Setting, simulate
from .trials import Trial, code_key, measure_trial

Methods = Mapping[str, Callable[[Surface], Found]]


@dataclass(frozen=True, kw_only=True)
class Crown:
    """setting: its name, for a scene its species; key: of the code and of everything that `grown` uses."""

    setting: str
    seed: int
    key: str
    grown: Callable[[], tuple[Surface, Truth]]

    def count(self, methods: Methods) -> list[Trial]:
        """Count the crown by every method."""
        surface, truth = self.grown()
        return [
            measure_trial(self.setting, self.seed, name, self.key, count(surface), truth)
            for name, count in methods.items()
        ]


def simulate_crowns(settings: Mapping[str, Setting], seeds: Sequence[int]) -> Iterator[Crown]:
    """Simulate one crown per setting and seed."""
    keys = {name: code_key(setting) for name, setting in settings.items()}
    for seed in seeds:
        for name, setting in settings.items():
            yield Crown(setting=name, seed=seed, key=keys[name], grown=partial(_grow, setting, seed))


def make_scene_crown(folder: Path, out: Path, stage: str, config: Config) -> Crown:
    """Make the crown of a generated scene in one of the ablation stages with true masks; trained Gaussians are cached
    in `out` (see `climb`).

    Raises:
        FruitLangsError: the scene or its truth cannot be read, the scene is incomplete, or does not name its species.
    """
    origin = read_origin(folder)
    if not origin.species or origin.seed is None:
        raise FormatError(f"{folder} does not say what grows there. Give a scene of make_orchard.py")
    truth = read_truth(folder / TRUTH, true_labels([origin.species]))
    masks = sorted(path for name in (INSTANCES, DEPTH) for path in (folder / name).glob("*.png"))
    seen = [Source(path=folder).hash(), file_hash(folder / TRUTH), files_hash(masks, folder), file_hash(_STAGES)]
    stages = LadderStages(folder, out, truth, read_views(folder / TRUTH), [origin.species], config)

    def grow() -> tuple[Surface, Truth]:
        given = stages.prepare_input(stage)
        return surface_of(given.gaussians, given.probability, given.cameras), truth

    return Crown(
        setting=origin.species, seed=origin.seed, key=code_key(stage_key((), config, stage, *seen)), grown=grow
    )


_STAGES = Path(__file__).resolve().parents[1] / "ladder" / "stages.py"


def _grow(setting: Setting, seed: int) -> tuple[Surface, Truth]:
    simulation = simulate(setting, seed)
    return surface_of(simulation.gaussians, simulation.probability, simulation.cameras), simulation.truth
