"""What each axis of the synthetic orchard changes, without a render."""

from __future__ import annotations

import subprocess
import sys
from dataclasses import asdict, fields, replace
from pathlib import Path

import numpy as np
import pytest

from fruitlangs.orchard.cameras.camera_path import Place, plan_views
from fruitlangs.orchard.cameras.close_ups import plan_close_ups
from fruitlangs.orchard.cameras.poses import disturb
from fruitlangs.orchard.cameras.shake import apply_shake
from fruitlangs.orchard.cameras.viewpoint import Viewpoint, look_at
from fruitlangs.orchard.check import check
from fruitlangs.orchard.config import FORMS, OrchardConfig
from fruitlangs.orchard.errors import OrchardError
from fruitlangs.orchard.planting import plant
from fruitlangs.orchard.plants.foliage import Leaves, rotate_in_wind
from fruitlangs.orchard.plants.tree import grow
from fruitlangs.orchard.scene_file import find_scene, presets, read_scene
from fruitlangs.orchard.shapes.ground import lay_ground
from fruitlangs.orchard.species import SPECIES, UNNAMED
from fruitlangs.orchard.surroundings.distractors import hang_tags
from fruitlangs.orchard.surroundings.objects import SIZES, make_pattern
from fruitlangs.orchard.surroundings.things import WORDS

SCRIPT = Path(__file__).resolve().parents[2] / "scripts" / "make_orchard.py"
APPLE = SPECIES["apple"]
PLACE = Place(crown=np.array([[-0.6, -0.6, 0.5], [0.6, 0.6, 1.7]]), half_row=0.0, part=None)


def tips(form: str) -> np.ndarray:
    """(N, 3) ends of the twigs of one tree."""
    return np.array([b.points[-1] for b in grow(np.random.default_rng(2), APPLE, form) if b.generation == 3])


def test_a_wall_is_flat_across_its_row_and_a_spindle_is_round() -> None:
    assert np.ptp(tips("wall")[:, 1]) < 0.25 * np.ptp(tips("wall")[:, 0])
    assert np.ptp(tips("spindle")[:, 1]) > 0.75 * np.ptp(tips("spindle")[:, 0])


def test_a_vase_has_an_open_centre_and_a_spindle_has_none() -> None:
    def in_the_centre(form: str) -> float:
        high = tips(form)[tips(form)[:, 2] > 1.0]
        return float((np.hypot(high[:, 0], high[:, 1]) < 0.4).mean())

    assert in_the_centre("vase") == 0.0
    assert in_the_centre("spindle") > 0.2


def test_a_bush_has_several_stems_from_the_ground_and_the_other_forms_one_trunk() -> None:
    def stems(form: str) -> int:
        return sum(b.points[0, 2] < 0.15 for b in grow(np.random.default_rng(2), APPLE, form))

    assert [stems(form) for form in ("spindle", "wall", "vase")] == [1, 1, 1]
    assert stems("bush") >= 7


@pytest.mark.parametrize("form", FORMS)
def test_every_form_bears_a_small_scene(form: str) -> None:
    assert len(plant(OrchardConfig(form=form, fruits=20, fallen=1, leaves=20)).fruits) == 21


def test_clump_sets_the_mean_clump_size() -> None:
    def mean(clump: float) -> float:
        fruits = plant(OrchardConfig(clump=clump, fruits=40, fallen=0, leaves=20)).fruits
        return len(fruits) / len({f.clump for f in fruits})

    assert mean(1.0) == 1.0
    assert 2.5 < mean(4.0) < 6.0


def test_spread_sets_the_deviation_of_diameters() -> None:
    def deviation(spread: float) -> float:
        sizes = np.array([f.diameter for f in plant(OrchardConfig(spread=spread, fruits=40, leaves=20)).fruits])
        return float(sizes.std() / sizes.mean())

    assert deviation(0.0) < 1e-9
    assert 0.2 < deviation(0.3) < 0.4


def test_five_consecutive_seeds_bear_from_half_to_one_and_a_half_times_the_fruit() -> None:
    configs = [OrchardConfig(load_variety=0.5, fruits=20, fallen=1, leaves=20, seed=seed) for seed in range(300, 305)]
    assert [config.hanging for config in configs] == [10, 15, 20, 25, 30]
    assert [len(plant(config).fruits) for config in configs] == [11, 16, 21, 26, 31]


def test_without_load_variety_every_seed_bears_the_same_number_of_fruit() -> None:
    assert {OrchardConfig(fruits=20, seed=seed).hanging for seed in range(10)} == {20}


def test_more_fruit_than_masks_hold_are_refused_for_the_seed_that_bears_most() -> None:
    check(OrchardConfig(load_variety=0.5, fruits=31_000, fallen=0, seed=302))
    with pytest.raises(OrchardError, match="16-bit"):
        check(OrchardConfig(load_variety=0.5, fruits=31_000, fallen=0, seed=304))


@pytest.mark.parametrize("species", [name for name in SPECIES if name not in UNNAMED])
def test_every_named_species_has_a_preset_whose_trees_bear_different_numbers(species: str) -> None:
    config = read_scene(find_scene(f"{species}-load")).config
    loads = [replace(config, seed=seed).hanging for seed in range(301, 306)]
    assert (config.species, config.views) == (species, 30)
    assert max(loads) >= 2.9 * min(loads)
    assert len(set(loads)) == 5


def test_a_row_has_trees_along_x_each_with_its_own_fruit() -> None:
    fruits = plant(OrchardConfig(trees=3, fruits=6, fallen=1, leaves=20)).fruits
    places = [np.mean([f.body.center[0] for f in fruits if f.tree == tree]) for tree in (1, 2, 3)]
    assert [sum(f.tree == tree for f in fruits) for tree in (1, 2, 3)] == [7, 7, 7]
    assert places[0] + 1.0 < places[1] < places[2] - 1.0


def test_neighbours_stand_behind_and_in_front_beyond_the_camera() -> None:
    config = OrchardConfig(neighbours=4, fruits=5, leaves=120, views=12)
    orchard = plant(config)
    cameras = plan_views(np.random.default_rng(0), config, orchard.species, orchard.place)
    farthest = max(abs(view.position[1]) for view in cameras)
    sides = [n.foot[1] for n in orchard.neighbours]
    assert sum(y > farthest for y in sides) == sum(y < -farthest for y in sides) == 2
    assert sum(f.kind == "neighbour" for f in orchard.fruits) == 20
    assert len(orchard.world_meshes) == len(orchard.fruits)


def test_a_neighbours_fruit_mesh_is_around_its_centre() -> None:
    orchard = plant(OrchardConfig(neighbours=2, fruits=4, leaves=120))
    for fruit, mesh in zip(orchard.fruits, orchard.world_meshes, strict=True):
        assert np.linalg.norm(mesh.vertices.mean(axis=0) - fruit.body.center) < 0.3 * fruit.diameter


def test_tags_flowers_and_posts_are_as_many_as_asked_for() -> None:
    orchard = plant(OrchardConfig(trees=2, tags=3, flowers=5, posts=4, fruits=2, leaves=120))
    assert (len(orchard.tags), len(orchard.flowers), len(orchard.ground.posts)) == (6, 10, 4)
    assert lay_ground(np.random.default_rng(0), size=1.0, posts=0).posts == ()


def test_objects_take_turns_stand_or_hang_about_their_tree_and_move_nothing_else() -> None:
    bare, full = (plant(OrchardConfig(fruits=5, leaves=20, things=count)) for count in (0, 7))
    words = [thing.word for thing in full.things]
    assert len(words) == 7
    assert set(words) == set(WORDS)
    assert words[:2] == words[5:]
    assert all(np.linalg.norm(thing.mesh.vertices.mean(axis=0)[:2]) < 5 for thing in full.things)
    assert all(thing.mesh.colors.shape == thing.mesh.vertices.shape for thing in full.things)
    assert [f.body.center.tolist() for f in bare.fruits] == [f.body.center.tolist() for f in full.fruits]


def test_objects_of_no_word_are_clear_of_the_fruit_and_move_nothing_else() -> None:
    bare, full = (plant(OrchardConfig(trees=2, fruits=20, leaves=20, objects=count)) for count in (0, 12))
    assert [thing.word for thing in full.things] == ["object"] * 24
    assert [f.body.center.tolist() for f in bare.fruits] == [f.body.center.tolist() for f in full.fruits]
    for thing in full.things:
        vertices = thing.mesh.vertices
        assert thing.mesh.colors.shape == vertices.shape
        assert np.ptp(vertices, axis=0).max() <= 1.01 * SIZES[1] * full.species.diameter
        assert all(np.linalg.norm(vertices - f.body.center, axis=1).min() > 0.2 * f.diameter for f in full.fruits)


def test_a_ball_is_never_painted_like_a_fruit_alone() -> None:
    ball = np.random.default_rng(1).normal(size=(50, 3))
    for seed in range(200):
        colors = make_pattern(np.random.default_rng(seed), ball, is_ball=True)
        assert (colors[:, 2] > 0.5 * colors[:, :2].max(axis=1)).mean() > 0.05


def test_every_third_close_up_looks_at_an_object() -> None:
    config = OrchardConfig(close_ups=True, views=6)
    things = np.array([[6.0, 0.0, 0.5], [-6.0, 1.0, 0.2]])
    views = plan_close_ups(np.random.default_rng(4), config, APPLE, PLACE.crown, [], things)
    middle = [config.width / 2, config.height / 2]
    seen = [view.project(things) for view in views]
    at_one = [bool(((np.linalg.norm(p - middle, axis=1) < 100) & (z > 0) & (z < 3)).any()) for p, z in seen]
    assert at_one == [False, True, False, False, True, False]


def test_a_setting_at_its_default_does_not_enter_the_digest_and_another_value_does(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    with_defaults = {"species": "plum", **{f.name: f.default for f in fields(OrchardConfig) if f.name != "species"}}
    assert OrchardConfig(**with_defaults).digest() == OrchardConfig(species="plum").digest()
    assert OrchardConfig(things=1).digest() != OrchardConfig().digest()
    before = OrchardConfig(species="plum").digest()
    monkeypatch.setattr("orchard.config.asdict", lambda config: {**asdict(config), "a_new_setting": 0})
    assert OrchardConfig(species="plum").digest() == before


def test_tags_hang_on_twigs() -> None:
    branches = grow(np.random.default_rng(1), APPLE)
    wood = np.vstack([b.points for b in branches])
    for tag in hang_tags(np.random.default_rng(1), branches, 5):
        assert np.linalg.norm(wood[:, None] - tag.vertices[None], axis=2).min() < 0.05


def test_a_half_ring_stays_on_its_side_and_a_ring_goes_around() -> None:
    def lowest_and_highest_y(path: str) -> tuple[float, float]:
        config = OrchardConfig(path=path, views=24)
        y = [v.position[1] for v in plan_views(np.random.default_rng(0), config, APPLE, PLACE)]
        return min(y), max(y)

    assert lowest_and_highest_y("ring")[1] > 2.0
    assert lowest_and_highest_y("half-ring")[0] < -2.0
    assert lowest_and_highest_y("half-ring")[1] < 0.5


def test_a_path_along_the_row_goes_to_and_fro_at_two_heights() -> None:
    config = OrchardConfig(path="row", views=20, trees=3)
    place = Place(crown=np.array([[-2.4, -0.6, 0.5], [2.4, 0.6, 1.7]]), half_row=1.8, part=None)
    spots = np.array([v.position for v in plan_views(np.random.default_rng(0), config, APPLE, place)])
    assert spots[:, 1].max() < -2.0
    assert (np.diff(spots[:10, 0]) > 0).all()
    assert (np.diff(spots[10:, 0]) < 0).all()
    assert spots[10:, 2].mean() - spots[:10, 2].mean() > 0.5


def test_a_flight_looks_down_on_one_side_of_the_row_and_then_on_the_other() -> None:
    config = OrchardConfig(path="flight", views=20, trees=3)
    place = Place(crown=np.array([[-2.4, -0.6, 0.5], [2.4, 0.6, 1.7]]), half_row=1.8, part=None)
    views = plan_views(np.random.default_rng(0), config, APPLE, place)
    spots = np.array([view.position for view in views])
    assert (spots[:, 2] > 2.5).all()
    assert spots[:10, 1].max() < -1.0 < 1.0 < spots[10:, 1].min()
    assert (np.diff(spots[:10, 0]) > 0).all()
    assert (np.diff(spots[10:, 0]) < 0).all()
    assert all(view.world_to_camera[2, 2] < -0.5 for view in views)


def test_a_narrow_picture_looks_at_a_part_of_the_crown_where_the_fruit_gather() -> None:
    config = OrchardConfig(species="cherry", width=300, height=225, fruit_pixels=14.0, fruits=30, leaves=120, views=6)
    orchard = plant(config)
    part = orchard.place.part
    assert part is not None
    centers = np.array([f.body.center for f in orchard.fruits if f.kind == "hanging"])
    for view in plan_views(np.random.default_rng(0), config, orchard.species, orchard.place):
        pixels, depths = view.project(centers)
        assert ((pixels > 0) & (pixels < [300, 225])).all(axis=1).mean() > 0.3
        assert np.median(view.focal * 0.023 / depths) == pytest.approx(14.0, rel=0.2)


def test_wind_turns_leaves_by_its_angle_about_their_foot() -> None:
    count = 2000
    frames = np.tile(np.eye(3), (count, 1, 1))
    leaves = Leaves(bases=np.zeros((count, 3)), frames=frames, lengths=np.ones(count), shades=np.zeros(count))
    after = rotate_in_wind(np.random.default_rng(0), leaves, 10.0)
    np.testing.assert_allclose(after @ after.transpose(0, 2, 1), frames, atol=1e-12)
    cosine = (np.trace(after, axis1=1, axis2=2) - 1) / 2
    assert np.degrees(np.sqrt((np.arccos(np.clip(cosine, -1, 1)) ** 2).mean())) == pytest.approx(10.0, rel=0.1)


def test_shake_spreads_a_bright_point_along_itself_and_keeps_its_light() -> None:
    picture = np.zeros((21, 21, 3), dtype=np.uint8)
    picture[10, 10] = 255
    blurred = apply_shake(picture, np.array([6.0, 0.0])) / 255.0
    light = np.where(blurred <= 0.04045, blurred / 12.92, ((blurred + 0.055) / 1.055) ** 2.4)[..., 0]
    assert np.flatnonzero(light.max(axis=1)).tolist() == [10]
    assert np.flatnonzero(light.max(axis=0)).tolist() == list(range(7, 14))
    assert light.sum() == pytest.approx(1.0, rel=0.02)


def test_pose_noise_turns_and_moves_by_its_deviation() -> None:
    pose = look_at(np.array([0.0, -2.0, 0.0]), np.zeros(3))
    views = [Viewpoint(name="a", focal=100.0, width=40, height=30, world_to_camera=pose)] * 2000
    noisy = disturb(np.random.default_rng(0), views, degrees=0.5, distance=2.0)
    moved = np.array([v.position - views[0].position for v in noisy])
    assert moved.std(axis=0) == pytest.approx(np.full(3, np.radians(0.5) * 2.0), rel=0.1)
    turns = np.array([v.world_to_camera[:, :3] @ pose[:, :3].T for v in noisy])
    angles = np.arccos(np.clip((np.trace(turns, axis1=1, axis2=2) - 1) / 2, -1, 1))
    assert np.degrees(np.sqrt((angles**2).mean())) == pytest.approx(0.5 * np.sqrt(3), rel=0.1)


def test_a_scene_file_overrides_the_scene_that_it_extends(tmp_path: Path) -> None:
    (tmp_path / "base.toml").write_text('about = "base"\nspecies = "pear"\nfruits = 7\n')
    (tmp_path / "axis.toml").write_text('extends = "base"\nfruits = 9\nfruit_pixels = 20\n')
    config = read_scene(tmp_path / "axis.toml").config
    assert (config.species, config.fruits, config.fruit_pixels) == ("pear", 9, 20)


@pytest.mark.parametrize(
    ("text", "word"),
    [
        ("frutis = 3", "frutis is no setting"),
        ("fruits = 3.5", "fruits is 3.5: give a whole number"),
        ("fruits = true", "fruits is True: give a whole number"),
        ('clump = "big"', "clump is 'big': give a number"),
        ("species = 3", "species is 3: give a text"),
        ("close_ups = 1", "close_ups is 1: give true or false"),
        ("extends = 3", "extends is 3"),
        ("fruits = ", "is no TOML"),
        ('extends = "nowhere"', "Scene nowhere cannot be found"),
        ('extends = "scene"', "extends itself"),
    ],
)
def test_a_scene_file_that_cannot_be_read_names_what_is_wrong(text: str, word: str, tmp_path: Path) -> None:
    (tmp_path / "scene.toml").write_text(text)
    with pytest.raises(OrchardError, match=word):
        read_scene(tmp_path / "scene.toml")


def test_every_preset_reads_says_what_it_is_for_and_makes_sense() -> None:
    scenes = presets()
    assert {f"{name}-small" for name in SPECIES} <= {scene.name for scene in scenes}
    for scene in scenes:
        check(scene.config)
        assert scene.about
        assert scene.config.seed < 1000


def test_presets_have_the_fruit_numbers_of_fruitnerfs_synthetic_trees() -> None:
    numbers = {"apple": 283, "plum": 781, "lemon": 326, "pear": 250, "peach": 152, "mango": 1150}
    assert {name: read_scene(find_scene(f"{name}-full")).config.fruits for name in numbers} == numbers


def test_list_prints_every_preset_in_one_line() -> None:
    done = subprocess.run([sys.executable, str(SCRIPT), "--list"], capture_output=True, text=True, check=False)
    assert done.returncode == 0
    assert [line.split()[0] for line in done.stdout.splitlines()] == [scene.name for scene in presets()]


def test_an_unknown_key_of_a_scene_file_is_one_line_and_leaves_no_folder(tmp_path: Path) -> None:
    (tmp_path / "odd.toml").write_text("frutis = 3\n")
    command = [sys.executable, str(SCRIPT), "--scene", str(tmp_path / "odd.toml"), "--out", str(tmp_path / "scene")]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert (done.returncode, done.stderr.count("\n")) == (1, 1)
    assert "frutis is no setting" in done.stderr
    assert not (tmp_path / "scene").exists()
