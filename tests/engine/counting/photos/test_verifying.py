"""What the network that verifies fruit learns from."""

from __future__ import annotations

from pathlib import Path

import fit_verifier
import numpy as np
import pytest
import torch
from balls_in_photos import balls_of, surroundings_of, views_of
from scipy.spatial import cKDTree

from fruitlangs.engine.counting.photos.places import NO_PLACES, Places
from fruitlangs.engine.counting.photos.search import FoundInPhotos, search_photos
from fruitlangs.engine.counting.photos.verifier import (
    SCENE,
    STORED,
    Looked,
    Network,
    load_networks,
    look,
    read_networks,
)
from fruitlangs.engine.evaluation.truth import Truth
from fruitlangs.fitting.counting import verifying
from fruitlangs.fitting.counting.verifying import (
    KNOWN_RADIUS_SD,
    MOST_TIMES,
    OPACITIES,
    PLACE_RADIUS_SD,
    VIEW_SUMS,
    Tree,
    _make_samples,
    _rescale,
    calibrate,
    fit,
    mine_samples,
    sample_around_truth,
)

SIZES = np.tile([0.06, 0.09], 6)
BALLS = balls_of(SIZES)


@pytest.fixture(scope="module")
def tree() -> Tree:
    """A tree with fruit of two sizes, the last of which is hidden."""
    truth = Truth(BALLS.centers, 2.0 * BALLS.radii, np.arange(12) < 11, np.ones(12))
    around = surroundings_of(BALLS, BALLS.centers[::2], 0.15)
    return Tree("ball", views_of(BALLS), around, truth, np.eye(3, 4))


@pytest.fixture
def looks(monkeypatch: pytest.MonkeyPatch) -> list[tuple[np.ndarray, ...]]:
    """The centres and radii of places, and those of known fruit, for which crops are cut."""
    taken = []

    def recorded(*given: object) -> Looked:
        taken.append(given[2:6])
        return look(*given)  # type: ignore[arg-type]

    monkeypatch.setattr(verifying, "look", recorded)
    return taken


def test_places_around_fruit_have_about_the_radii_of_the_nearest_ones(
    tree: Tree, looks: list[tuple[np.ndarray, ...]]
) -> None:
    sample_around_truth(tree, np.random.default_rng(0))
    ((centers, radii, _, _),) = looks
    visible = tree.truth.visible
    nearest = cKDTree(BALLS.centers[visible]).query(centers)[1]
    off = np.log(radii / BALLS.radii[visible][nearest])
    assert abs(off.mean()) < 4.0 * PLACE_RADIUS_SD / np.sqrt(len(off))
    assert off.std() == pytest.approx(PLACE_RADIUS_SD, rel=0.2)


def test_known_fruit_have_about_their_own_radii(tree: Tree, looks: list[tuple[np.ndarray, ...]]) -> None:
    sample_around_truth(tree, np.random.default_rng(0))
    ((_, _, known, known_radii),) = looks
    assert len(known) == 11
    off = np.log(known_radii / BALLS.radii[:11])
    assert 0.3 * KNOWN_RADIUS_SD < off.std() < 2.0 * KNOWN_RADIUS_SD
    assert abs(off.mean()) < KNOWN_RADIUS_SD


def test_mistakes_are_learnt_with_the_radii_that_the_search_found_and_with_others(
    tree: Tree, looks: list[tuple[np.ndarray, ...]]
) -> None:
    samples = mine_samples(tree, load_networks(), np.random.default_rng(0))
    found = search_photos(tree.verifier(load_networks()), tree.diameter, tree.frame)
    (exact, radii, known, known_radii), (moved, radii_of_moved, _, _) = looks
    assert np.array_equal(exact, found.places.centers)
    assert np.array_equal(radii, found.places.radii)
    assert 0.0 < np.abs(np.log(radii_of_moved / radii)).mean() < 2.0 * KNOWN_RADIUS_SD
    assert np.array_equal(known, found.places.centers[: found.known])
    assert np.array_equal(known_radii, found.places.radii[: found.known])
    assert 0.0 < np.abs(moved - exact).mean() < 0.1
    assert samples.fruit.sum() >= 11


def test_growths_that_are_learnt_are_those_from_the_radius_of_a_place_to_that_of_its_fruit(tree: Tree) -> None:
    places = Places(BALLS.centers[:2], BALLS.radii[:2] * [0.8, 1.25])
    samples = _make_samples(tree, places, NO_PLACES, np.full((2, 1), -1), np.zeros((2, 11), bool))
    assert samples.fruit.tolist() == [1.0, 1.0]
    assert np.exp(samples.growths.numpy()) == pytest.approx([1.25, 0.8])


def test_shifts_that_are_learnt_are_those_from_which_the_verifier_moves_to_the_fruit(tree: Tree) -> None:
    aside = Places(BALLS.centers[:1] + [0.01, -0.02, 0.02], BALLS.radii[:1])
    samples = _make_samples(tree, aside, NO_PLACES, np.full((1, 1), -1), np.zeros((1, 11), bool))
    chosen, _ = tree.views.choose(aside.centers, aside.radii, samples.exists.shape[1])
    moves = tree.verifier(load_networks())._moves(
        aside.centers, aside.radii, chosen, samples.shifts, torch.full(samples.exists.shape, -4.0)
    )
    assert samples.near.any()
    np.testing.assert_allclose(moves[0], BALLS.centers[0] - aside.centers[0], atol=0.001)


def test_places_are_also_learnt_as_if_their_tree_had_other_numbers_of_photos_and_gaussians() -> None:
    scene = torch.rand(2000, SCENE) + 0.5
    numbers = _rescale(scene, torch.Generator().manual_seed(0))
    changed = (numbers != scene).any(0).nonzero()[:, 0].tolist()
    assert changed == [*range(SCENE)[VIEW_SUMS], *range(SCENE)[OPACITIES]]
    for part in (VIEW_SUMS, OPACITIES):
        times = torch.expm1(numbers[:, part]) / torch.expm1(scene[:, part])
        assert (times - times[:, :1]).abs().max() < 1e-3
        assert MOST_TIMES * 0.98 < float(times.max()) < MOST_TIMES * 1.01
        assert float(times.min()) == pytest.approx(1.0 / MOST_TIMES, rel=0.03)


def test_equal_places_train_equal_networks(tree: Tree) -> None:
    samples = sample_around_truth(tree, np.random.default_rng(0))
    one, other = (fit(samples, epochs=1, seed=0) for _ in range(2))
    assert all((a == b).all() for a, b in zip(one.parameters(), other.parameters(), strict=True))


def test_a_network_is_added_to_those_of_a_file(tree: Tree, monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setattr(fit_verifier, "prepare_trees", lambda _: [tree])
    out, given = tmp_path / "out.safetensors", {"renders": tmp_path, "add": STORED, "rounds": 0, "epochs": 1}
    fit_verifier.main(fit_verifier.Options(out=out, **given))
    before, after = read_networks(STORED), read_networks(out)
    assert len(after.networks.networks) == len(before.networks.networks) + 1
    assert after.notes == [*before.notes, {"trees": ["ball"], "calibrated on": []}]
    for kept, own in zip(after.networks.networks, before.networks.networks, strict=False):
        assert all((a == b).all() for a, b in zip(kept.parameters(), own.parameters(), strict=True))


def test_log_odds_are_calibrated_to_the_share_of_places_that_are_fruit(
    tree: Tree, monkeypatch: pytest.MonkeyPatch
) -> None:
    """At twelve log odds of 0 one place of three is a fruit; at those of 2 two of three are."""
    false = BALLS.centers[:11] + [0.0, 0.0, 5.0]
    centers = np.concatenate([BALLS.centers[:4], false[:8], BALLS.centers[4:11], false[8:], false[:1]])
    odds = np.repeat([0.0, 2.0], [12, 11])
    found = FoundInPhotos(Places.alike(centers, 0.15), odds, 0, np.ones(len(odds)), 0.15)
    monkeypatch.setattr(verifying, "search_photos", lambda *_: found)
    network, before = Network(), Network()
    before.load_state_dict(network.state_dict())
    calibrate(network, [tree])
    (weight, bias), (weight_before, bias_before) = (
        (each.together[-1].weight.detach(), each.together[-1].bias.detach()) for each in (network, before)
    )
    assert torch.equal(weight[1:], weight_before[1:])
    assert bias[1] == bias_before[1]
    scale = float((weight[0] / weight_before[0]).median())
    assert float(bias[0] - scale * bias_before[0]) == pytest.approx(np.log(4 / 8), abs=0.02)
    assert 2.0 * scale == pytest.approx(np.log(7 / 4) - np.log(4 / 8), abs=0.02)


def test_errors_of_radii_are_calibrated_to_those_of_trees_that_were_not_learnt_from(
    tree: Tree, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Radii are off by a tenth, and the network said 2 %."""
    visible = BALLS.select(np.arange(11))
    off = Places(visible.centers, visible.radii * np.exp(0.1 * (-1.0) ** np.arange(11)))
    false = Places(off.centers + [0.0, 0.0, 5.0], off.radii)
    found = FoundInPhotos(Places.join([off, false]), np.repeat([2.0, -1.0], 11), 0, np.full(22, 0.02), 0.15)
    monkeypatch.setattr(verifying, "search_photos", lambda *_: found)
    network, before = Network(), Network()
    before.load_state_dict(network.state_dict())
    calibrate(network, [tree])
    widening = float((network.together[-1].bias - before.together[-1].bias)[2].detach())
    assert widening == pytest.approx(np.log(1.48 * 0.1 / 0.02))
