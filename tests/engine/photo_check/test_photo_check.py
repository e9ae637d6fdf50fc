"""The check of photos names what is wrong with them, and finds nothing in good ones.

A walk is made of a long random picture that closes to a ring: every photo is a window of it, and the next photo shows
the window a step farther on.
"""

from __future__ import annotations

import functools
import json
import shutil
from collections.abc import Callable, Sequence
from pathlib import Path

import films
import numpy as np
import pytest
from PIL import ExifTags, Image, ImageFilter
from scipy import ndimage

from fruitlangs.engine.config import Config, CountConfig, SceneConfig, TrainConfig
from fruitlangs.engine.errors import Cancelled, OutputError, SceneError
from fruitlangs.engine.photo_check import findings
from fruitlangs.engine.photo_check.check import check_photos, fruit_share
from fruitlangs.engine.photo_check.cost import estimate_costs
from fruitlangs.engine.photo_check.exposure import most_involved
from fruitlangs.engine.photo_check.finding import Finding, PhotoCheck
from fruitlangs.engine.photo_check.sharpness import LEAST_SHARE, find_blurred, relative_sharpness, sharpness
from fruitlangs.engine.photo_check.sheet import COLOURS, contact_sheet, sheet_folder, write_sheet
from fruitlangs.engine.progress import silent

SAMPLE = Path(__file__).resolve().parents[3] / "examples" / "orchard_tree"
WIDTH, HEIGHT, STEP, RING = 420, 300, 100, 24
Edit = Callable[[Image.Image], Image.Image]


@functools.cache
def ring(seed: int) -> np.ndarray:
    """(HEIGHT, RING * STEP, 3): random blobs of several sizes, which close to a ring."""
    rng = np.random.default_rng(seed)
    shape = HEIGHT, RING * STEP, 3
    layers = [ndimage.gaussian_filter(rng.normal(size=shape), (s, s, 0), mode="wrap") * s for s in (0.7, 2, 5)]
    values = sum(layers)
    return np.clip(110 + 45 * values / values.std(), 0, 255).astype(np.uint8)


def photo(place: int, seed: int = 1) -> Image.Image:
    columns = np.arange(place * STEP, place * STEP + WIDTH) % (RING * STEP)
    return Image.fromarray(ring(seed)[:, columns])


def save(folder: Path, pictures: Sequence[Image.Image]) -> Path:
    folder.mkdir(exist_ok=True)
    for number, picture in enumerate(pictures):
        picture.save(folder / f"{number:03d}.jpg", quality=95)
    return folder


def walk(folder: Path, places: Sequence[int] = range(RING), edits: dict[int, Edit] | None = None) -> Path:
    """A folder of the photos from these places, in order; edits: {number: change of that photo}."""
    return save(folder, [(edits or {}).get(n, lambda each: each)(photo(place)) for n, place in enumerate(places)])


def check(folder: Path) -> PhotoCheck:
    return check_photos(folder, free=1 << 40)


def found(result: PhotoCheck, kind: str) -> Finding:
    (only,) = [finding for finding in result.findings if finding.kind == kind]
    return only


def kinds(result: PhotoCheck) -> set[str]:
    """The findings without the number of photos, which is small here to save time."""
    return {finding.kind for finding in result.findings} - {"few photos"}


def brighter(stops: float) -> Edit:
    """sRGB is close to a power of 2.2 of linear light."""
    return lambda each: each.point(lambda value: int(value * 2 ** (stops / 2.2)))


@pytest.fixture(autouse=True)
def unmeasured_fruit(monkeypatch: pytest.MonkeyPatch) -> None:
    """Random pictures show no fruit, and measuring them takes seconds."""
    monkeypatch.setattr("fruitlangs.engine.photo_check.check.fruit_share", lambda *_: None)


def test_a_good_walk_has_no_findings(tmp_path: Path) -> None:
    result = check(walk(tmp_path / "walk"))
    assert kinds(result) == set()
    assert all(photo.links >= 4 for photo in result.photos)


@functools.cache
def sample_greys() -> list[np.ndarray]:
    files = sorted((SAMPLE / "images").iterdir())
    return [np.asarray(Image.open(file).convert("L"), dtype=np.float32) for file in files]


def moved(grey: np.ndarray, pixels: int) -> np.ndarray:
    """Blurred by a horizontal motion."""
    return ndimage.uniform_filter1d(grey, pixels + 1, axis=1)


def test_no_photo_of_the_sample_is_taken_for_blurred() -> None:
    assert min(relative_sharpness([sharpness(grey) for grey in sample_greys()])) > 1.5 * LEAST_SHARE


@pytest.mark.parametrize(
    "blur", [lambda grey: ndimage.gaussian_filter(grey, 2.0), lambda grey: moved(grey, 6)], ids=["gaussian", "motion"]
)
def test_every_photo_of_the_sample_is_found_if_it_alone_is_blurred(blur: Callable[[np.ndarray], np.ndarray]) -> None:
    sharp = [sharpness(grey) for grey in sample_greys()]
    blurred = [sharpness(blur(grey)) for grey in sample_greys()]
    shares = [relative_sharpness([*sharp[:i], blurred[i], *sharp[i + 1 :]])[i] for i in range(len(sharp))]
    assert max(shares) < LEAST_SHARE


def test_a_series_of_blurred_photos_is_found() -> None:
    assert find_blurred([10.0] * 10 + [2.0] * 10 + [10.0] * 10) == [False] * 10 + [True] * 10 + [False] * 10


def test_sharpness_that_changes_slowly_is_not_blur() -> None:
    assert not any(find_blurred(list(np.geomspace(5.0, 15.0, 30))))


def test_blurred_photos_are_named(tmp_path: Path) -> None:
    blur = {7: lambda each: each.filter(ImageFilter.GaussianBlur(2.0))}
    result = check(walk(tmp_path / "walk", range(12), blur))
    assert kinds(result) == {"blur"}
    assert found(result, "blur").photos == ["007.jpg"]


def test_photos_that_are_all_soft_are_reported_once(tmp_path: Path) -> None:
    soft = [photo(place).filter(ImageFilter.GaussianBlur(2.5)) for place in range(8)]
    assert kinds(check(save(tmp_path / "soft", soft))) == {"soft"}


def test_a_gap_is_named_by_the_photos_on_both_sides(tmp_path: Path) -> None:
    result = check(walk(tmp_path / "walk", [*range(9), *range(15, RING)]))
    assert "between 008.jpg and 009.jpg" in found(result, "gap").sentence
    assert found(result, "gap").photos == ["008.jpg", "009.jpg"]


def test_a_missing_photo_that_its_neighbours_cover_is_not_a_gap(tmp_path: Path) -> None:
    assert kinds(check(walk(tmp_path / "walk", [*range(6), *range(8, 12)]))) == set()


def test_a_second_walk_at_the_same_places_is_not_a_gap(tmp_path: Path) -> None:
    assert kinds(check(walk(tmp_path / "walk", [*range(2, 11), *range(2, 11)]))) == set()


def test_two_groups_without_common_content_are_a_problem(tmp_path: Path) -> None:
    one, other = [photo(place) for place in range(8)], [photo(place, seed=2) for place in range(6)]
    finding = found(check(save(tmp_path / "two", [*one, *other])), "groups")
    assert finding.severity == "problem"
    assert "8 from 000.jpg to 007.jpg; 6 from 008.jpg to 013.jpg" in finding.sentence
    assert "between 007.jpg and 008.jpg" in finding.advice
    assert finding.photos == [f"{number:03d}.jpg" for number in range(8, 14)]


def test_a_photo_of_something_else_overlaps_with_no_other(tmp_path: Path) -> None:
    result = check(walk(tmp_path / "walk", range(12), {5: lambda _: photo(5, seed=3)}))
    assert found(result, "no overlap").photos == ["005.jpg"]
    assert "gap" not in kinds(result)


def test_photos_without_any_overlap_are_a_problem(tmp_path: Path) -> None:
    result = check(walk(tmp_path / "walk", range(0, RING, 7)))
    assert found(result, "no overlap").severity == "problem"


def test_equal_photos_are_all_alike(tmp_path: Path) -> None:
    result = check(walk(tmp_path / "walk", [3] * 6))
    assert found(result, "all alike").severity == "problem"


def test_two_photos_are_too_few_and_a_problem(tmp_path: Path) -> None:
    result = check(walk(tmp_path / "walk", range(2)))
    finding = found(result, "few photos")
    assert kinds(result) == set()
    assert (finding.severity, finding.sentence) == ("problem", "There are only 2 photos")


def test_a_jump_of_exposure_names_the_photo_and_not_its_neighbours(tmp_path: Path) -> None:
    result = check(walk(tmp_path / "walk", range(12), {6: brighter(-1.2)}))
    assert found(result, "exposure").photos == ["006.jpg"]
    assert "--train.exposure" in found(result, "exposure").advice


def test_a_slow_change_of_light_is_not_a_jump(tmp_path: Path) -> None:
    slow = {number: brighter(-0.1 * number) for number in range(12)}
    assert kinds(check(walk(tmp_path / "walk", range(12), slow))) == set()


def test_a_shift_of_the_white_balance_is_named(tmp_path: Path) -> None:
    def warmer(each: Image.Image) -> Image.Image:
        red, green, blue = each.split()
        return Image.merge("RGB", [red, green, blue.point(lambda value: int(0.75 * value))])

    result = check(walk(tmp_path / "walk", range(12), {6: warmer}))
    assert found(result, "white balance").photos == ["006.jpg"]


def test_few_photos_explain_all_jumps() -> None:
    assert most_involved([(4, 5), (5, 6), (5, 7), (10, 11)]) == [5, 10]


def test_an_unreadable_photo_is_a_problem_and_the_others_are_checked(tmp_path: Path) -> None:
    folder = walk(tmp_path / "walk", range(6))
    (folder / "003.jpg").write_bytes((folder / "003.jpg").read_bytes()[:400])
    result = check(folder)
    assert found(result, "unreadable").photos == ["003.jpg"]
    assert found(result, "unreadable").severity == "problem"
    assert [photo.thumbnail is None for photo in result.photos] == [False] * 3 + [True] + [False] * 2


def test_raw_files_alone_are_a_problem_with_advice(tmp_path: Path) -> None:
    (tmp_path / "DSC_1.NEF").write_bytes(b"raw")
    (tmp_path / "DSC_2.dng").write_bytes(b"raw")
    finding = found(check(tmp_path), "RAW")
    assert (finding.severity, finding.photos) == ("problem", ["DSC_1.NEF", "DSC_2.dng"])
    assert "Convert them to JPEG" in finding.advice


def test_raw_files_next_to_photos_of_the_same_names_are_a_warning(tmp_path: Path) -> None:
    folder = walk(tmp_path / "walk", range(6))
    for number in range(6):
        (folder / f"{number:03d}.NEF").write_bytes(b"raw")
    assert found(check(folder), "RAW").severity == "warning"


def test_photos_of_another_size_are_of_another_camera(tmp_path: Path) -> None:
    result = check(walk(tmp_path / "walk", range(8), {6: lambda each: each.resize((560, 400))}))
    assert found(result, "cameras").photos == ["006.jpg"]
    assert "7 of 420×300; 1 of 560×400" in found(result, "cameras").sentence


def test_photos_of_another_focal_length_are_named(tmp_path: Path) -> None:
    folder = walk(tmp_path / "walk", range(6))
    for number in range(6):
        exif = Image.Exif()
        exif[ExifTags.Base.Model] = "Phone"
        exif.get_ifd(ExifTags.IFD.Exif)[ExifTags.Base.FocalLengthIn35mmFilm] = 26 if number < 4 else 52
        photo(number).save(folder / f"{number:03d}.jpg", exif=exif)
    finding = found(check(folder), "cameras")
    assert "4 of Phone, 26 mm, 420×300; 2 of Phone, 52 mm, 420×300" in finding.sentence
    assert finding.photos == ["004.jpg", "005.jpg"]


def test_portrait_photos_among_landscape_ones_are_named(tmp_path: Path) -> None:
    turned = {4: lambda each: each.transpose(Image.Transpose.ROTATE_90)}
    result = check(walk(tmp_path / "walk", range(6), turned))
    assert found(result, "orientation").photos == ["004.jpg"]
    assert "cameras" not in kinds(result)


def test_the_orientation_in_exif_is_applied(tmp_path: Path) -> None:
    folder = walk(tmp_path / "walk", range(6))
    exif = Image.Exif()
    exif[ExifTags.Base.Orientation] = 6
    photo(4).transpose(Image.Transpose.ROTATE_90).save(folder / "004.jpg", exif=exif, quality=95)
    assert kinds(check(folder)) == set()


def test_a_folder_without_photos_is_an_error(tmp_path: Path) -> None:
    with pytest.raises(SceneError, match="has no photos"):
        check(tmp_path)


def test_the_photos_of_a_scene_with_cameras_are_checked_without_a_camera_search(few_photos: Path) -> None:
    result = check(few_photos)
    assert len(result.photos) == 8
    assert [cost.stage for cost in result.costs] == ["training", "computing features", "counting"]


def test_photos_alone_include_the_camera_search(tmp_path: Path) -> None:
    assert check(walk(tmp_path / "walk", range(3))).costs[0].stage == "finding cameras"


def test_twice_the_photos_take_twice_as_long_to_search_and_more_cores_less() -> None:
    few, many = (estimate_costs([(640, 480)] * n, Config(), posed=False, cores=2) for n in (40, 80))
    fast = estimate_costs([(640, 480)] * 80, Config(), posed=False, cores=8)
    assert many[0].seconds == pytest.approx(2 * few[0].seconds)
    assert all(quick.seconds < slow.seconds for quick, slow in zip(fast, many, strict=True))


def test_expected_time_follows_the_settings_of_training() -> None:
    def training(config: Config) -> float:
        return estimate_costs([(1600, 1200)] * 40, config, posed=True, cores=2)[0].seconds

    assert training(Config(train=TrainConfig(steps=400))) == pytest.approx(training(Config()) / 3)
    assert training(Config(scene=SceneConfig(downscale=4))) < training(Config())


@pytest.mark.parametrize("trees", [{"trees": 6}, {"tree_places": tuple(float(i) for i in range(18))}])
def test_a_row_of_200_photos_is_expected_to_train_longer_and_not_at_once_or_of_one_tree(trees: dict) -> None:
    def training(config: Config) -> float:
        return estimate_costs([(360, 270)] * 200, config, posed=True, cores=2)[0].seconds

    at_once = training(Config())  # with more steps, because photos are more than 60
    assert training(Config(count=CountConfig(**trees))) == pytest.approx(
        1.5 * 200 / 70 * at_once / (200 / 60) ** 0.5, rel=1e-3
    )
    assert training(Config(count=CountConfig(**trees), scene=SceneConfig(sections=1))) == at_once
    assert training(Config(count=CountConfig(trees=1))) == at_once


def test_too_little_memory_is_a_problem(tmp_path: Path) -> None:
    result = check_photos(walk(tmp_path / "walk", range(3)), free=100 << 20)
    assert found(result, "memory").severity == "problem"
    assert "0.1 GB are free" in found(result, "memory").sentence


def about_fruit(share: float | None, side: int, **scene: int) -> list[Finding]:
    return findings.check_fruit(share, [(side, side * 3 // 4)] * 3, Config(scene=SceneConfig(**scene)))


def test_narrow_fruit_are_reported_with_their_width_and_what_to_do() -> None:
    (found,) = about_fruit(0.006, 1600)
    assert (found.severity, found.kind) == ("warning", "narrow fruit")
    assert found.sentence == (
        "The fruit are about 10 pixels wide in the photos as read (0.6% of the longer side), and 14 are needed: fruit "
        "will be missing"
    )
    assert found.advice.startswith("Take photos from nearer")


def test_fruit_too_narrow_for_any_shape_are_a_problem() -> None:
    assert [found.severity for found in about_fruit(0.004, 1600)] == ["problem"]


@pytest.mark.parametrize(("share", "side"), [(0.0075, 1600), (0.006, 4000), (None, 1600), (0.003, 1600)])
def test_wide_fruit_fruit_that_are_read_larger_and_no_fruit_are_no_finding(share: float | None, side: int) -> None:
    assert about_fruit(share, side) == []


def test_a_size_that_the_user_set_is_kept_and_the_files_size_is_the_advice() -> None:
    (found,) = about_fruit(0.006, 4000, max_side=1200)
    assert "about 7 pixels wide" in found.sentence
    assert found.advice == "Read the photos larger with --scene.max-side 4000"


def test_the_width_of_fruit_is_measured_in_the_photos() -> None:
    share = fruit_share(sorted((SAMPLE / "images").iterdir()), Config(), silent)
    assert share is not None
    assert 480 * share == pytest.approx(16.2, rel=0.2)


def test_photos_with_narrow_fruit_take_longer_to_encode() -> None:
    def seconds(fruit: float) -> float:
        costs = estimate_costs([(1600, 1200)] * 40, Config(), posed=True, fruit=fruit, cores=2)
        return next(cost.seconds for cost in costs if cost.stage == "computing features")

    assert seconds(15.0 / 1600) == pytest.approx(4.0 * seconds(30.0 / 1600), rel=0.01)


def test_a_cancel_ends_the_check(tmp_path: Path) -> None:
    def cancel(fraction: float, message: str) -> None:
        if message.startswith("comparing"):
            raise Cancelled

    with pytest.raises(Cancelled):
        check_photos(walk(tmp_path / "walk", range(6)), progress=cancel)


def test_the_contact_sheet_frames_the_photos_of_the_findings(tmp_path: Path) -> None:
    folder = walk(tmp_path / "walk", range(6))
    (folder / "003.jpg").write_bytes(b"no picture")
    sheet = np.asarray(contact_sheet(check(folder)))
    framed = (sheet == COLOURS["problem"]).all(axis=2).any(axis=0).nonzero()[0]
    cell = sheet.shape[1] / 6
    assert 3 * cell < framed.min() < framed.max() < 4 * cell + 10


def test_a_sheet_is_written_next_to_the_photos_and_never_among_them(tmp_path: Path) -> None:
    folder = walk(tmp_path / "walk", range(3))
    with pytest.raises(OutputError, match="inside the folder of the photos"):
        sheet_folder(folder, folder / "check")
    assert sheet_folder(folder) == tmp_path / "walk-check"
    assert sheet_folder(folder / "transforms.json") == tmp_path / "walk-check"
    with pytest.raises(OutputError, match=r"is a whole drive\. Use --out"):
        sheet_folder(Path(folder.anchor))
    path = sheet_folder(folder, tmp_path / "check") / "sheet.png"
    write_sheet(path, check(folder))
    assert Image.open(path).format == "PNG"


def test_a_file_of_another_kind_is_an_error_that_says_what_is_read(tmp_path: Path) -> None:
    (tmp_path / "cloud.las").write_bytes(b"points")
    with pytest.raises(SceneError, match="what is read"):
        check(tmp_path / "cloud.las")


def test_photos_of_the_same_name_in_several_folders_are_distinguished(few_photos: Path, tmp_path: Path) -> None:
    scene = shutil.copytree(few_photos, tmp_path / "scene")
    document = json.loads((scene / "transforms.json").read_text())
    for number, frame in enumerate(document["frames"]):
        folder = scene / ("left" if number % 2 else "right")
        folder.mkdir(exist_ok=True)
        name = f"{folder.name}/{number // 2}.jpg"
        (scene / frame["file_path"]).rename(scene / name)
        frame["file_path"] = name
    (scene / "transforms.json").write_text(json.dumps(document))
    assert [photo.name for photo in check(scene).photos][:2] == ["left/0.jpg", "left/1.jpg"]


def test_the_stills_of_a_video_are_checked_and_nothing_is_left_behind(tmp_path: Path) -> None:
    film = films.write_film(tmp_path / "walk.mp4", [films.picture(at) for at in np.linspace(0.0, 2.0, 90)])
    check = check_photos(film)
    assert len(check.photos) > 20
    assert list(tmp_path.iterdir()) == [film]
