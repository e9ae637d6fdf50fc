"""The synthetic orchard: its bodies, its truth, its sparse cloud, and a tiny rendered scene."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from orchard_runs import read_grey

from fruitlangs.engine.errors import VocabularyError
from fruitlangs.engine.language.vocabulary import CONCEPTS, parse
from fruitlangs.orchard.cameras.viewpoint import Viewpoint, look_at
from fruitlangs.orchard.check import check
from fruitlangs.orchard.config import FIRST_TRAINING_SEED, OrchardConfig
from fruitlangs.orchard.errors import OrchardError
from fruitlangs.orchard.files.png import read_grey as png_read_grey
from fruitlangs.orchard.files.png import write_grey
from fruitlangs.orchard.files.sparse import sample_cloud
from fruitlangs.orchard.files.truth import Visibility, count_silhouette_pixels, fruit_record, measure_visibilities
from fruitlangs.orchard.planting import plant
from fruitlangs.orchard.plants.crop import PlacedFruit
from fruitlangs.orchard.plants.fruiting import Fruiting
from fruitlangs.orchard.plants.tree import grow
from fruitlangs.orchard.shapes.body import Body, measure_gap, measure_signed_distance, smooth_profile, surface_points
from fruitlangs.orchard.shapes.branch import sample_wood
from fruitlangs.orchard.shapes.meshes import Mesh
from fruitlangs.orchard.species import SPECIES, UNNAMED
from fruitlangs.orchard.training_scenes import ROUNDS, WALK_VIEWS, is_held_out, training_config


def front_view(width: int = 40, height: int = 30) -> Viewpoint:
    """A camera at (0, -2, 0) that looks along +y; a pixel spans 0.05 m at distance 2."""
    pose = look_at(np.array([0.0, -2.0, 0.0]), np.zeros(3))
    return Viewpoint(name="001.jpg", focal=40.0, width=width, height=height, world_to_camera=pose)


def square(half: float) -> Mesh:
    """A box around the origin, `half` wide to each side, as a closed mesh."""
    corners = half * np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)], dtype=np.float64)
    quads = np.array([[0, 1, 3, 2], [4, 6, 7, 5], [0, 4, 5, 1], [2, 3, 7, 6], [0, 2, 6, 4], [1, 5, 7, 3]])
    return Mesh(vertices=corners, quads=quads)


def ball(center: tuple[float, float, float], radius: float) -> Body:
    """A sphere as a body of revolution."""
    turn = np.linspace(0.0, np.pi, 60)
    profile = radius * np.stack([np.cos(turn), np.sin(turn)], axis=1)
    return Body(center=np.array(center), axis=np.array([0.0, 0.0, 1.0]), profile=profile)


def test_signed_distance_to_a_ball_is_distance_to_its_centre_less_its_radius() -> None:
    points = np.random.default_rng(0).normal(size=(200, 3))
    expected = np.linalg.norm(points - [0.1, 0.2, 0.3], axis=1) - 0.5
    np.testing.assert_allclose(measure_signed_distance(ball((0.1, 0.2, 0.3), 0.5), points), expected, atol=1e-3)


def test_gap_between_balls_is_negative_when_they_overlap() -> None:
    assert measure_gap(ball((0, 0, 0), 0.5), ball((0.9, 0, 0), 0.5)) == pytest.approx(-0.1, abs=5e-3)
    assert measure_gap(ball((0, 0, 0), 0.5), ball((1.2, 0, 0), 0.5)) == pytest.approx(0.2, abs=5e-3)


@pytest.mark.parametrize("name", list(SPECIES))
def test_a_species_profile_has_the_volume_of_a_unit_sphere(name: str) -> None:
    profile = smooth_profile(SPECIES[name].profile, 400)
    height, area = profile[:, 0], np.pi * profile[:, 1] ** 2
    volume = float((-np.diff(height) * (area[1:] + area[:-1]) / 2).sum())
    assert volume == pytest.approx(np.pi / 6, rel=2e-3)


@pytest.mark.parametrize("name", ["apple", "pear", "cherry"])
def test_fruit_touch_in_clumps_and_never_run_into_each_other(name: str) -> None:
    orchard = plant(OrchardConfig(species=name, seed=3, fruits=30, leaves=50))
    bodies = [f.body for f in orchard.fruits]
    mean = float(np.mean([f.diameter for f in orchard.fruits]))
    gaps = np.array([[measure_gap(a, b) for b in bodies[:i]] + [np.inf] * (31 + 4 - i) for i, a in enumerate(bodies)])
    assert gaps.min() >= -0.02 * mean
    touching = int((gaps < 0.01 * mean).sum())
    clumps = np.bincount([f.clump for f in orchard.fruits if f.clump])
    assert touching >= int(np.maximum(clumps - 1, 0).sum()) > 0


def test_fruit_stay_out_of_the_wood() -> None:
    orchard = plant(OrchardConfig(seed=4, fruits=40, leaves=50))
    wood = sample_wood(orchard.branches)
    for fruit in orchard.fruits:
        assert (measure_signed_distance(fruit.body, wood[:, :3]) - wood[:, 3]).min() >= 0.0


def test_surface_points_lie_on_the_body() -> None:
    body = plant(OrchardConfig(seed=1, fruits=1, fallen=0, leaves=1)).fruits[0].body
    assert np.abs(measure_signed_distance(body, surface_points(body))).max() < 1e-9


def test_all_faces_of_a_fruit_look_outward() -> None:
    (mesh,) = plant(OrchardConfig(seed=1, fruits=1, fallen=0, leaves=1)).fruit_meshes
    triangles = mesh.triangles
    edges = {(int(a), int(b)) for t in triangles for a, b in zip(t, np.roll(t, -1), strict=True)}
    assert len(edges) == 3 * len(triangles)  # each is walked once this way …
    assert all((b, a) in edges for a, b in edges)  # … and once back, so neighbours agree
    a, b, c = mesh.vertices[triangles.T]
    assert np.einsum("ij,ij->i", a, np.cross(b, c)).sum() > 0


def test_the_same_seed_plants_the_same_orchard_and_another_seed_another() -> None:
    config = OrchardConfig(seed=5, fruits=10, leaves=100)
    centers = [np.array([f.body.center for f in plant(c).fruits]) for c in (config, config, replace(config, seed=6))]
    assert np.array_equal(centers[0], centers[1])
    assert not np.array_equal(centers[0], centers[2])


def test_silhouette_of_a_box_covers_the_pixel_centres_inside_it() -> None:
    # The near face, 0.5 to each side at distance 1.5, spans ±13.33 pixels: 26 centres each way.
    assert count_silhouette_pixels(front_view(), square(0.5)) == 26 * 26


def test_silhouette_is_cut_at_the_picture() -> None:
    assert count_silhouette_pixels(front_view(width=10, height=30), square(0.5)) == 10 * 26


def test_visible_needs_three_views_with_enough_share_and_pixels() -> None:
    enough = Visibility(visible_pixels=(12, 12, 12), whole_pixels=(120, 120, 120))
    too_few_views = Visibility(visible_pixels=(12, 12, 11), whole_pixels=(100, 100, 100))
    too_small_a_share = Visibility(visible_pixels=(12, 12, 12), whole_pixels=(120, 120, 121))
    assert (enough.visible, too_few_views.visible, too_small_a_share.visible) == (True, False, False)


def test_visible_fraction_is_the_largest_share_over_views() -> None:
    shown = Visibility(visible_pixels=(10, 30, 0), whole_pixels=(100, 60, 0))
    assert shown.visible_fraction == pytest.approx(0.5)


def test_visibilities_count_the_mask_of_each_fruit() -> None:
    mask = np.zeros((30, 40), dtype=np.uint16)
    mask[2:5, 3:10] = 2
    (shown,) = measure_visibilities([front_view()], [mask], [2], [square(0.5)])
    assert shown.visible_pixels == (21,)
    assert shown.whole_pixels == (676,)


def test_truth_names_the_share_that_each_view_shows_and_never_calls_a_neighbour_visible() -> None:
    shown = Visibility(visible_pixels=(12, 0, 30, 60), whole_pixels=(60, 0, 60, 60))
    body = ball((0, 0, 0), 0.04)
    fruit = PlacedFruit(id=1, body=body, diameter=0.08, kind="hanging", anchor=None, clump=1, tree=2)
    record = fruit_record(fruit, "apple", shown, ["a", "b", "c", "d"])
    assert record["visible_fractions"] == {"a": 0.2, "c": 0.5, "d": 1.0}
    assert (record["visible"], record["tree"]) == (True, 2)
    assert fruit_record(replace(fruit, kind="neighbour"), "apple", shown, ["a", "b", "c", "d"])["visible"] is False


def test_the_sparse_cloud_lies_on_what_is_seen_and_not_at_fruit_centres() -> None:
    # Two cameras see a wall at y = 0; a fruit's centre 0.04 behind the surface must not show up.
    views = [front_view(), replace(front_view(), name="002.jpg")]
    depths = [np.full((30, 40), 2.0, dtype=np.float32)] * 2
    pictures = [np.full((30, 40, 3), 99, dtype=np.uint8)] * 2
    cloud = sample_cloud(np.random.default_rng(0), views, depths, pictures, 400)
    assert len(cloud.points) == 400
    assert np.abs(cloud.points[:, 1]).max() < 0.015
    assert all(track == (0, 1) for track in cloud.tracks)
    assert (cloud.colors == 99).all()


def test_our_reader_reads_what_our_writer_wrote(tmp_path: Path) -> None:
    values = np.array([[0, 1, 65535], [300, 7, 256]], dtype=np.uint16)
    write_grey(tmp_path / "m.png", values)
    assert np.array_equal(png_read_grey(tmp_path / "m.png"), values)


def test_png_of_16_bits_keeps_its_values(tmp_path: Path) -> None:
    values = np.array([[0, 1, 65535], [300, 7, 256]], dtype=np.uint16)
    write_grey(tmp_path / "m.png", values)
    assert np.array_equal(read_grey(tmp_path / "m.png"), values)


def test_training_scenes_take_species_in_turn_and_start_at_their_own_seeds() -> None:
    configs = [training_config(FIRST_TRAINING_SEED + i) for i in range(24)]
    assert {c.species for c in configs} == set(SPECIES) - set(UNNAMED)
    assert [i for i, c in enumerate(configs) if c.views == WALK_VIEWS] == [14]
    assert all(c.seed >= 1000 for c in configs)
    assert {c.close_ups for c in configs} == {True, False}
    assert len({(c.species, c.variant) for c in configs}) > 16
    assert len({c.form for c in configs}) > 2
    for config in configs:
        check(config)


NAMED = ("apple", "pear", "cherry", "plum", "lemon", "orange", "peach", "mango")
"""The species that training scenes take turns with, as they always did."""


def test_training_seeds_give_the_same_species_as_before_there_were_unnamed_ones() -> None:
    species = [training_config(FIRST_TRAINING_SEED + i).species for i in range(3 * len(NAMED))]
    assert species == list(NAMED) * 3


def test_species_that_the_encoder_has_no_word_for_are_never_learnt_from() -> None:
    seeds = range(FIRST_TRAINING_SEED, FIRST_TRAINING_SEED + 40 * len(SPECIES))
    assert {training_config(seed).species for seed in seeds} == set(SPECIES) - set(UNNAMED)
    assert set(UNNAMED) == {"fig", "eggplant"}
    assert set(UNNAMED) <= set(SPECIES)
    assert not set(UNNAMED) & set(CONCEPTS)
    for name in UNNAMED:
        with pytest.raises(VocabularyError):
            parse(name)


def test_whole_rounds_through_the_named_species_are_held_out() -> None:
    seeds = range(FIRST_TRAINING_SEED, FIRST_TRAINING_SEED + 2 * ROUNDS * len(NAMED))
    held_out = [training_config(seed).species for seed in seeds if is_held_out(seed)]
    assert held_out == list(NAMED) * 2


def test_every_variety_of_the_unnamed_species_makes_sense_and_is_planted() -> None:
    for name in UNNAMED:
        for variant in SPECIES[name].variants:
            config = OrchardConfig(species=name, variant=variant.name, seed=2, fruits=6, fallen=0, leaves=20)
            check(config)
            assert len(plant(config).fruits) == 6


def test_an_eggplant_is_more_than_three_times_as_long_as_wide() -> None:
    profile = smooth_profile(SPECIES["eggplant"].profile, 400)
    assert np.ptp(profile[:, 0]) / (2.0 * profile[:, 1].max()) > 3.0


@pytest.mark.parametrize(
    ("wrong", "word"),
    [
        ({"species": "durian"}, "durian"),
        ({"variant": "blue"}, "blue"),
        ({"views": 0}, "views"),
        ({"form": "hedge"}, "form 'hedge'"),
        ({"path": "spiral"}, "path 'spiral'"),
        ({"aim": "sky"}, "aim 'sky'"),
        ({"clump": 0.5}, "clump is 0.5"),
        ({"spread": 0.9}, "spread is 0.9"),
        ({"trees": 0}, "trees is 0"),
        ({"neighbours": -1}, "neighbours is -1"),
        ({"posts": -2}, "posts is -2"),
        ({"tags": -1}, "tags is -1"),
        ({"flowers": -1}, "flowers is -1"),
        ({"exposure_drift": -0.1}, "exposure_drift is -0.1"),
        ({"white_balance_drift": 3.0}, "white_balance_drift is 3.0"),
        ({"motion_blur": float("nan")}, "motion_blur is nan"),
        ({"leaf_motion": 100.0}, "leaf_motion is 100.0"),
        ({"pose_noise": -1.0}, "pose_noise is -1.0"),
        ({"tree_height": 0.1}, "tree_height is 0.1"),
        ({"aim": "part", "trees": 2}, "aim part"),
        ({"fruits": 20000, "trees": 2}, "32000"),
    ],
)
def test_a_setting_that_makes_no_sense_is_named(wrong: dict[str, object], word: str) -> None:
    with pytest.raises(OrchardError, match=word):
        check(OrchardConfig(**wrong))  # type: ignore[arg-type]


def test_more_fruit_than_the_tree_holds_is_an_error() -> None:
    rng = np.random.default_rng(0)
    trunk_and_a_limb = grow(rng, SPECIES["mango"])[:2]
    fruiting = Fruiting(rng, SPECIES["mango"], trunk_and_a_limb)
    with pytest.raises(OrchardError, match="ask for fewer"):
        fruiting.hang(300)
