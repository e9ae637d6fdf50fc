"""Training of the network that verifies fruit in photos: examples from rendered trees, and mistakes of its own."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, fields
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.spatial import cKDTree
from torch import Tensor
from torch.nn import functional

from ...engine.config import CountConfig
from ...engine.counting.evidence.cluster import LIKELY
from ...engine.counting.evidence.visibility import frame_of
from ...engine.counting.photos.places import Places
from ...engine.counting.photos.search import UNLIKELY, find_likely_places, search_photos
from ...engine.counting.photos.surroundings import FARTHEST, Surroundings
from ...engine.counting.photos.surroundings import NUMBERS as SURROUNDINGS
from ...engine.counting.photos.verifier import SCENE, Network, Networks, Verifier, find_known_near, look
from ...engine.counting.photos.view_kernels import CHANNELS, DOWN, RIGHT
from ...engine.counting.photos.views import PhotoViews
from ...engine.evaluation.judgement import Judgement, judge
from ...engine.evaluation.truth import Truth
from ...engine.language.encoders.embedded import EmbeddedEncoder
from ..encoder.calibration import logistic
from ..encoder.lifted import KEPT, train_once
from .cases import Case, encode, iterate_rendered_trees, search_case

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]

BEST, OTHERS = 500, 400
"""Places of a tree that are learnt from: the best ones by their score, and random ones of the rest."""
JITTERS = (0.08, 0.2, 0.35, 0.5)
"""Standard deviations, in diameters, of places around every true fruit."""
ON, OFF = 0.45, 0.52
"""Diameters from a fruit within which a place is on it, and from which it is not; between them places weigh less."""
BETWEEN, BETWEEN_WEIGHT = 0.38, 0.3
SHOULDER = 1.0
"""Diameters from a fruit within which shifts to it are learnt."""
KNOWN_SHARE, KNOWN_SD, NOTHING_KNOWN = 0.85, 0.07, 0.25
"""Share of the true fruit that are known to a place, the deviation of their centres in diameters, and the share of
places to which nothing is known."""
STILL_FREE = 0.35
"""Share of the places near a fruit to which this fruit is not known."""
MINED_SD = 0.06
"""Deviation in diameters by which found places are moved in their second copy."""
PLACE_RADIUS_SD, KNOWN_RADIUS_SD = 0.15, 0.08
"""Deviations of the logarithms of radii: of places, and of known fruit and of the second copy of found places."""
BATCH, RATE, DECAY, SHIFT_WEIGHT, SIZE_WEIGHT = 128, 2e-3, 1e-3, 0.3, 0.3
MOST_DROPPED = 0.5
"""Largest share of its views that are left out of a place; the share is random."""
UNMATCHED = 0.15
"""Share of the places around which no Gaussian matches the prompt, as where trained Gaussians lose a fruit."""
MOST_TIMES = 2.5
"""Places are learnt with up to this many times as many photos, and as dense Gaussians, as their tree has, or as few:
trees for training have half as many photos as people take of a whole tree."""
VIEW_SUMS, OPACITIES = slice(0, 5), slice(SCENE - SURROUNDINGS + 2, SCENE - SURROUNDINGS + 4)
"""The numbers of the scene that grow with the photos, and those that grow with the Gaussians on a fruit."""


@dataclass(frozen=True, eq=False)
class Tree:
    """A rendered tree ready to be searched. frame: (3, 4) of its cameras, see `visibility.frame_of`."""

    name: str
    views: PhotoViews
    surroundings: Surroundings
    truth: Truth
    frame: FloatArray

    @property
    def diameter(self) -> float:
        return self.surroundings.diameter

    def verifier(self, network: Network | Networks) -> Verifier:
        return Verifier(network, self.views, self.surroundings)


def prepare_trees(renders: Path) -> Iterator[Tree]:
    """Yield every rendered tree that is round in some part, with Gaussians trained on it, which are kept in its folder.

    Raises:
        FormatError: a walk's seed is not recorded, or is kept for tests.
    """
    encoder, threshold = EmbeddedEncoder.open(), CountConfig().threshold
    for folder, scene, species, truth in iterate_rendered_trees(renders):
        gaussians = train_once(folder / KEPT, scene)
        probability, maps = encode(gaussians, scene, species, encoder)
        family = f"walk {folder.name}"
        result = search_case(Case("photos", family, gaussians, probability, scene.cameras, truth, truth.visible))
        if result is None or maps is None:
            continue
        found, pictures = result
        fruit = found.found.spheres.centers[found.probabilities > LIKELY]
        surroundings = Surroundings.of(gaussians, probability.double().numpy(), fruit, found.size.diameter, threshold)
        yield Tree(folder.name, PhotoViews.of(pictures, maps), surroundings, truth, frame_of(scene.cameras))


@dataclass(frozen=True, eq=False)
class Samples:
    """S places. crops: (S, K, C, n, n) float16; exists: (S, K); scene: (S, D); fruit: (S,) whether a fruit that is not
    known is there; shifts: (S, K, 2) to the nearest such fruit, in radii; near: (S, K) where shifts are learnt;
    growths: (S,) the logarithm of that fruit's radius over the place's; weights: (S,)."""

    crops: Tensor
    exists: Tensor
    scene: Tensor
    fruit: Tensor
    shifts: Tensor
    near: Tensor
    growths: Tensor
    weights: Tensor

    def __len__(self) -> int:
        return len(self.fruit)

    @staticmethod
    def join(parts: Sequence[Samples]) -> Samples:
        return Samples(
            **{each.name: torch.cat([getattr(part, each.name) for part in parts]) for each in fields(Samples)}
        )


def sample_around_truth(tree: Tree, rng: np.random.Generator) -> Samples:
    """Sample places behind pixels that show fruit, around true fruit and on fruit that were found, each about as large
    as the nearest true fruit and with most of the other true fruit known."""
    truth, diameter = tree.truth, tree.truth.mean_diameter
    places = find_likely_places(tree.views, tree.surroundings.fruit, diameter, tree.frame)
    rest = rng.permutation(places[BEST:])[:OTHERS]
    visible, true_radii = truth.centers[truth.visible], truth.diameters[truth.visible] / 2.0
    jittered = [visible + rng.normal(size=visible.shape) * diameter * sd for sd in JITTERS]
    centers = np.concatenate([places[:BEST], rest, *jittered, tree.surroundings.fruit])
    distances, nearest = cKDTree(visible).query(centers)
    free = (distances < true_radii[nearest]) | (rng.random(len(centers)) < STILL_FREE)
    known = Places(
        visible + rng.normal(size=visible.shape) * diameter * KNOWN_SD,
        add_radius_errors(true_radii, KNOWN_RADIUS_SD, rng),
    )
    near = find_known_near(centers, known, np.where(free, nearest, -1))
    some = rng.random(near.shape) < KNOWN_SHARE
    some &= (rng.random(len(centers)) >= NOTHING_KNOWN)[:, None]
    near = _pack(np.where(some, near, -1))
    explained = np.zeros((len(centers), len(visible)), bool)
    rows, columns = np.nonzero(near >= 0)
    explained[rows, near[rows, columns]] = True
    radii = add_radius_errors(true_radii[nearest], PLACE_RADIUS_SD, rng)
    return _make_samples(tree, Places(centers, radii), known, near, explained)


def add_radius_errors(radii: FloatArray, sd: float, rng: np.random.Generator) -> FloatArray:
    """Return radii (S,) with errors; sd: the standard deviation of their logarithms."""
    return radii * np.exp(rng.normal(size=len(radii)) * sd)


def mine_samples(tree: Tree, network: Network | Networks, rng: np.random.Generator) -> Samples:
    """Return where the network looks for fruit, right or wrong, with the radii that it measures there, each with the
    fruit that are known to it."""
    truth = tree.truth
    found = search_photos(tree.verifier(network), tree.diameter, tree.frame)
    places, numbers = found.places, np.arange(len(found.places))
    known, visible = places.select(numbers < found.known), truth.centers[truth.visible]
    taken = np.full(len(visible), -1)
    if len(known):
        distances, owners = cKDTree(known.centers).query(visible)
        taken = np.where(distances < truth.diameters[truth.visible] / 2.0, owners, -1)
    own = np.where(numbers < found.known, numbers, -1)
    explained = (taken[None] >= 0) & (taken[None] != own[:, None])
    parts = []
    for sd, radius_sd in ((0.0, 0.0), (MINED_SD, KNOWN_RADIUS_SD)):
        centers = places.centers + rng.normal(size=places.centers.shape) * found.diameter * sd
        near, radii = find_known_near(centers, known, own), add_radius_errors(places.radii, radius_sd, rng)
        parts.append(_make_samples(tree, Places(centers, radii), known, near, explained))
    return Samples.join(parts)


def _pack(near: IntArray) -> IntArray:
    """Return each row with its numbers first and -1 after them."""
    return np.take_along_axis(near, np.argsort(near < 0, axis=1, kind="stable"), 1)


def _make_samples(
    tree: Tree,
    places: Places,
    known: Places,
    near: IntArray,
    explained: NDArray[np.bool_],
) -> Samples:
    """Return what the network is given of places as `Verifier.verify` gives it, and what it should answer; explained:
    (S, F) which visible fruit are known to each place."""
    truth, centers, radii = tree.truth, places.centers, places.radii
    diameters = truth.diameters[truth.visible]
    visible, hidden = truth.centers[truth.visible], truth.centers[~truth.visible]
    looked = look(tree.views, tree.surroundings, centers, radii, known.centers, known.radii, near)
    distances = np.linalg.norm(visible[None] - centers[:, None], axis=2) / diameters
    distances[explained] = np.inf
    target = distances.argmin(axis=1)
    distance = distances[np.arange(len(centers)), target]
    to_hidden = (
        cKDTree(hidden).query(centers)[0] / truth.mean_diameter if len(hidden) else np.full(len(centers), np.inf)
    )
    exists = looked.chosen >= 0
    kept = ((to_hidden > 0.5) | (distance < 0.5)) & (exists.sum(axis=1) >= 2)
    own, depths = tree.views.project(centers, looked.chosen)
    there, _ = tree.views.project(visible[target], looked.chosen)
    pixels = tree.views.lenses[np.maximum(looked.chosen, 0), 0] * radii[:, None] / depths
    shifts = (there - own) / pixels[..., None]
    near_one = (distance < SHOULDER)[:, None] & exists
    weights = np.where((distance > BETWEEN) & (distance < OFF), BETWEEN_WEIGHT, 1.0)
    return Samples(
        torch.from_numpy(looked.crops[kept]).half(),
        torch.from_numpy(exists[kept]),
        torch.from_numpy(looked.scene[kept]),
        torch.from_numpy((distance < ON)[kept].astype(np.float32)),
        torch.from_numpy(np.where(near_one[..., None], shifts, 0.0)[kept].astype(np.float32)),
        torch.from_numpy(near_one[kept]),
        torch.from_numpy(np.log(diameters[target] / (2.0 * radii))[kept].astype(np.float32)),
        torch.from_numpy(weights[kept].astype(np.float32)),
    )


def fit(samples: Samples, *, epochs: int, seed: int, report: Callable[[str], None] = lambda _: None) -> Network:
    """Train a network from scratch. Crops are turned and mirrored at random, and some views are left out."""
    torch.manual_seed(seed)
    network, generator = Network(), torch.Generator().manual_seed(seed)
    batches = len(samples) // BATCH
    optimiser = torch.optim.AdamW(network.parameters(), lr=RATE, weight_decay=DECAY)
    schedule = torch.optim.lr_scheduler.OneCycleLR(optimiser, RATE, total_steps=epochs * batches)
    for epoch in range(epochs):
        order, losses = torch.randperm(len(samples), generator=generator), [0.0, 0.0, 0.0]
        for number in range(batches):
            rows = order[number * BATCH : (number + 1) * BATCH]
            crops, shifts = _rotate_and_mirror(samples.crops[rows].float(), samples.shifts[rows], generator)
            dropped = MOST_DROPPED * torch.rand(len(rows), 1, generator=generator)
            exists = samples.exists[rows]
            exists = exists & (torch.rand(exists.shape, generator=generator) >= dropped)
            odds, guesses, errors, growths, size_errors = network(
                crops, exists, _mask_matches(_rescale(samples.scene[rows], generator), generator)
            )
            verdict = functional.binary_cross_entropy_with_logits(
                odds, samples.fruit[rows], weight=samples.weights[rows]
            )
            learnt = (samples.near[rows] & exists).float()
            off = (guesses - shifts).abs().sum(-1)
            shift = ((off * torch.exp(-errors) + 2.0 * errors) * learnt).sum() / learnt.sum().clamp_min(1.0)
            misses = (growths - samples.growths[rows]).abs() * torch.exp(-size_errors) + size_errors
            size = (misses * samples.fruit[rows]).sum() / samples.fruit[rows].sum().clamp_min(1.0)
            optimiser.zero_grad()
            (verdict + SHIFT_WEIGHT * shift + SIZE_WEIGHT * size).backward()
            optimiser.step()
            schedule.step()
            losses = [
                loss + float(part.detach()) / batches for loss, part in zip(losses, (verdict, shift, size), strict=True)
            ]
        report("epoch {} of {}: verdict {:.3f}, shift {:.3f}, size {:.3f}".format(epoch + 1, epochs, *losses))
    return network.eval()


def _mask_matches(scene: Tensor, generator: torch.Generator) -> Tensor:
    """Return the numbers of the scene (n, SCENE), some of them as if the Gaussians around did not match the prompt."""
    numbers = scene[:, -SURROUNDINGS:]
    _, _, around, within, _ = numbers.unbind(1)
    nothing = torch.zeros_like(around)
    lost = torch.stack([nothing + FARTHEST, nothing, nothing, torch.maximum(around, within), nothing], dim=1)
    some = torch.rand(len(scene), 1, generator=generator) < UNMATCHED
    return torch.cat([scene[:, :-SURROUNDINGS], torch.where(some, lost, numbers)], dim=1)


def _rescale(scene: Tensor, generator: torch.Generator) -> Tensor:
    """Numbers of the scene (n, SCENE), as if it had more or fewer photos and Gaussians, see MOST_TIMES."""
    draws = 2.0 * torch.rand(len(scene), 2, generator=generator) - 1.0
    photos, gaussians = torch.exp(math.log(MOST_TIMES) * draws).split(1, dim=1)
    numbers = scene.clone()
    for part, times in ((VIEW_SUMS, photos), (OPACITIES, gaussians)):
        numbers[:, part] = torch.log1p(torch.expm1(scene[:, part]) * times)
    return numbers


def calibrate(network: Network, trees: Sequence[Tree]) -> None:
    """Scale and shift the log odds, in place, to those with which the places found in trees are fruit, and the errors
    of radii to those that they have there; the trees are not learnt from."""
    odds, fruit, errors = [], [], []
    for tree in trees:
        found = search_photos(tree.verifier(network), tree.diameter, tree.frame)
        judged = judge(found.places.centers, 2.0 * found.places.radii, tree.truth, 0.5)
        own = np.setdiff1d(np.flatnonzero(found.log_odds > UNLIKELY), judged.ignored)
        odds.append(found.log_odds[own])
        fruit.append(np.isin(own, judged.pairs.predicted))
        errors.append(measure_radius_errors(tree, found.places, judged) / found.radius_sds[judged.pairs.predicted])
    said, true = np.concatenate(odds), np.concatenate(fruit)
    temperature, bias = logistic(said, true, np.ones(len(said)))
    widening = 1.48 * float(np.median(np.abs(np.concatenate(errors))))
    with torch.no_grad():
        last = network.together[-1]
        assert isinstance(last, torch.nn.Linear)
        last.weight[0] /= temperature
        last.bias[0] = last.bias[0] / temperature - bias
        last.bias[2] += np.log(widening)


def measure_radius_errors(tree: Tree, places: Places, judged: Judgement) -> FloatArray:
    """Measure (M,) the logarithm of the radii over the true ones, of the matched places in their judgement."""
    pairs = judged.pairs
    errors: FloatArray = np.log(2.0 * places.radii[pairs.predicted] / tree.truth.diameters[pairs.true])
    return errors


def _rotate_and_mirror(crops: Tensor, shifts: Tensor, generator: torch.Generator) -> tuple[Tensor, Tensor]:
    """Mirror and rotate crops and shifts alike."""
    way = int(torch.randint(0, 8, (1,), generator=generator))
    channels, signs = list(range(CHANNELS)), torch.ones(CHANNELS, 1, 1)
    if way & 1:
        crops, shifts, signs[RIGHT] = crops.flip(-1), shifts * torch.tensor([-1.0, 1.0]), -1.0
    if way & 2:
        crops, shifts, signs[DOWN] = crops.flip(-2), shifts * torch.tensor([1.0, -1.0]), -1.0
    crops = crops * signs
    if way & 4:
        channels[RIGHT], channels[DOWN] = DOWN, RIGHT
        crops, shifts = crops.transpose(-1, -2)[..., channels, :, :], shifts.flip(-1)
    return crops, shifts
