"""Scenes with ground truth for fitting the numbers of counting: simulated crowns, and rendered trees, trained and with
true surfaces."""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray

from _terminal import terminal_progress

from ...benchmarks.counting.baselines import surface_of
from ...benchmarks.counting.simulated import Setting, simulate
from ...benchmarks.orchards import TRUTH, read_origin
from ...engine.config import CountConfig, SceneConfig
from ...engine.counting.evidence.cluster import Search, search
from ...engine.counting.evidence.visibility import Picture, draw
from ...engine.counting.photos.join import PhotoEvidence, add_photos
from ...engine.errors import ConfigError
from ...engine.evaluation.renders import read_depths, read_instances
from ...engine.evaluation.true_surface import true_surface
from ...engine.evaluation.truth import Truth, read_truth, true_labels
from ...engine.language.encoders.embedded import EmbeddedEncoder
from ...engine.language.features.lift import encode_photos, lift_features
from ...engine.language.features.photo_features import PhotoFeaturesRecorder
from ...engine.language.prompts.photo_probability import PhotoMap, photo_probabilities
from ...engine.language.prompts.relevancy import relevancy
from ...engine.photo_size import photo_scales
from ...engine.scene.camera import Camera, Scene
from ...engine.scene.read import read_scene
from ...engine.splatting.gaussians import Gaussians
from ...orchard.config import FIRST_TRAINING_SEED
from ...orchard.files.truth import is_visible
from ..encoder.lifted import KEPT, find_rendered_scenes, measure_true_fruit, train_once
from ..encoder.pictures import training_seeds


@dataclass(frozen=True, eq=False)
class Case:
    """Gaussians with a probability (N,) of being fruit, the cameras, and the truth.

    kind: of scene; family: cases that are never judged by what was fitted to another of them; shown: (M,) the true
    fruit of which three views show a tenth; maps: what the photos show, if the photos are searched for fruit too.
    """

    kind: str
    family: str
    gaussians: Gaussians
    probability: torch.Tensor
    cameras: Sequence[Camera]
    truth: Truth
    shown: NDArray[np.bool_]
    maps: Sequence[PhotoMap] | None = None


def check_seed(first: int) -> None:
    """Refuse to learn from the seeds of tests and tables."""
    if first < FIRST_TRAINING_SEED:
        raise ConfigError(f"Seeds below {FIRST_TRAINING_SEED} are for tests and tables. Give a larger --first")


def simulate_cases(settings: Mapping[str, Setting], seeds: Sequence[int]) -> Iterator[Case]:
    """Simulate one crown per setting and seed."""
    progress, todo = terminal_progress(), [(name, seed) for seed in seeds for name in settings]
    for place, (name, seed) in enumerate(todo):
        progress(place / len(todo), f"{name}, seed {seed}")
        crown = simulate(settings[name], seed)
        yield Case(name, f"crown {seed}", crown.gaussians, crown.probability, crown.cameras, crown.truth, crown.shown)
    progress(1.0, "crowns done")


def iterate_rendered_cases(renders: Path) -> Iterator[Case]:
    """Yield Gaussians trained on rendered trees, with true masks and with the package's encoder."""
    encoder = EmbeddedEncoder.open()
    for folder, scene, species, truth in iterate_rendered_trees(renders):
        gaussians = train_once(folder / KEPT, scene)
        said, maps = encode(gaussians, scene, species, encoder)
        kinds = [
            ("walk, true masks", measure_true_fruit(folder, scene, gaussians), None),
            ("walk, encoder", said, None),
            ("walk, encoder and photos", said, maps),
        ]
        for kind, probability, shown in kinds:
            family = f"walk {folder.name}"
            yield Case(kind, family, gaussians, probability, scene.cameras, truth, truth.visible, shown)


def iterate_halved_cases(renders: Path) -> Iterator[Case]:
    """Yield Gaussians trained in the quick preset on every second photo of rendered trees, with the package's encoder
    and what these photos show. The Gaussians are kept in the tree's folder."""
    encoder = EmbeddedEncoder.open()
    for folder, whole, species, truth in iterate_rendered_trees(renders):
        scene = replace(whole, cameras=whole.cameras[::2], images=whole.images[::2])
        gaussians = train_once(folder / "gaussians-half.ply", scene, "quick")
        probability, maps = encode(gaussians, scene, species, encoder)
        shown = find_shown(folder / TRUTH, truth, [photo.name for photo in scene.images])
        family = f"walk {folder.name}"
        yield Case("walk, half of the photos", family, gaussians, probability, scene.cameras, truth, shown, maps)


def find_shown(path: Path, truth: Truth, photos: Sequence[str]) -> NDArray[np.bool_]:
    """Find (M,) which true fruit of the `truth.json` at `path` enough of these photos show."""
    assert truth.ids is not None
    shown = set()
    for fruit in json.loads(path.read_text(encoding="utf-8"))["fruits"]:
        pixels = [fruit["visible_pixels"].get(name, 0) for name in photos]
        fractions = [fruit["visible_fractions"].get(name, 0.0) for name in photos]
        if is_visible(pixels, fractions):
            shown.add(fruit["id"])
    return np.isin(truth.ids, list(shown))


def encode(
    gaussians: Gaussians, scene: Scene, species: str, encoder: EmbeddedEncoder
) -> tuple[torch.Tensor, list[PhotoMap] | None]:
    """Return what the encoder says of a species: the probability (N,) of the Gaussians, and the maps of the photos."""
    recorder = PhotoFeaturesRecorder(encoder.kinds(), encoder.fruit_identity)
    photos = encode_photos(scene, encoder, photo_scales(scene, encoder), recorder)
    features = lift_features(gaussians, scene.cameras, photos, encoder_id=encoder.identity)
    probability = relevancy(features, encoder, [species])
    return probability, photo_probabilities(recorder.collect(), features, encoder, [species])


def iterate_surface_cases(renders: Path) -> Iterator[Case]:
    """Yield the true surfaces of rendered trees as their views show them, with true masks."""
    for folder, scene, _, truth in iterate_rendered_trees(renders):
        surface = true_surface(scene, read_depths(folder, scene), read_instances(folder, scene))
        probability = torch.from_numpy((surface.fruit > 0).astype(np.float64))
        kind = "walk, true surfaces"
        yield Case(kind, f"walk {folder.name}", surface.gaussians, probability, scene.cameras, truth, truth.visible)


def iterate_rendered_trees(renders: Path) -> Iterator[tuple[Path, Scene, str, Truth]]:
    """Yield folder, scene, species and truth of each rendered tree.

    Raises:
        FormatError: a walk's seed is not recorded, or is kept for tests.
    """
    progress, folders = terminal_progress(), find_rendered_scenes(renders)
    training_seeds(folders)
    for place, folder in enumerate(folders):
        progress(place / len(folders), f"walk {folder.name}")
        species = read_origin(folder).species
        yield folder, read_scene(folder, SceneConfig()), species, read_truth(folder / TRUTH, true_labels([species]))
    progress(1.0, "walks done")


def search_case(case: Case) -> tuple[Search, list[Picture]] | None:
    """Find the candidates of a case with their probabilities, and its views; None if no part of it is round."""
    surface = surface_of(case.gaussians, case.probability, case.cameras)
    if surface.sample is None:
        return None
    points, size = surface.sample
    pictures = draw(case.gaussians, case.probability.double().numpy(), case.cameras)
    threshold = CountConfig().threshold
    found = search(points, size, pictures, threshold)
    if case.maps is None:
        return found, pictures
    evidence = PhotoEvidence(case.gaussians, case.probability.double().numpy(), case.maps)
    return add_photos(found, evidence, pictures, threshold), pictures
