"""Teaching a word on the command line: what it writes, the count that uses it, and errors in one line."""

from __future__ import annotations

import contextlib
import importlib
import io
import json
import shutil
import signal
import subprocess
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import ball_scene
import numpy as np
import pytest
from PIL import Image

from fruitlangs.engine.config import EmbedConfig
from fruitlangs.engine.language.encoders.open_encoder import open_encoder
from fruitlangs.engine.language.taught.word import TaughtWord, read_word, save_word
from fruitlangs.engine.language.teaching.photo_marks import ray_through
from fruitlangs.engine.language.teaching.ray_hits import pick_surface
from fruitlangs.engine.open_result import open_result

ROOT = Path(__file__).resolve().parents[2]
VIEW, GROUND = 3, (20.0, 90.0)
"""A photo of the balls, and a pixel of it that shows the ground."""


@pytest.fixture(autouse=True)
def own_words(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The user's folder of words, empty."""
    folder = tmp_path / "words of the user"
    monkeypatch.setenv("FRUITLANGS_WORDS", str(folder))
    return folder


def run(script: str, *arguments: object) -> subprocess.CompletedProcess[str]:
    """A script, run in this process as in its own: its exit code and what it prints."""
    given = [str(ROOT / "scripts" / f"{script}.py"), *map(str, arguments)]
    out, err, code = io.StringIO(), io.StringIO(), 0
    handlers = {number: signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)}
    try:
        with pytest.MonkeyPatch.context() as patch, contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
            patch.setattr(sys, "argv", given)
            module = importlib.import_module(script)
            importlib.import_module("_terminal").run(module.main)
    except SystemExit as exit:
        code = int(exit.code or 0)
    finally:
        for number, handler in handlers.items():
            signal.signal(number, handler)
    return subprocess.CompletedProcess(given, code, out.getvalue(), err.getvalue())


def teach(result: Path, *arguments: object) -> subprocess.CompletedProcess[str]:
    return run("teach_word", result, *arguments)


def count(result: Path, out: Path, *arguments: object) -> subprocess.CompletedProcess[str]:
    return run("count_fruit", result, "--out", out, "--no-blend", "--count.threshold", "0.3", *arguments)


def click(x: float, y: float, view: int = VIEW) -> str:
    return f"{view:03d}.png:{x:g},{y:g}"


def click_on_ball(number: int, view: int = VIEW) -> str:
    """The middle of a ball in a photo, where the truth says that this ball is in front."""
    pose = ball_scene.poses(16)[view]
    x, y, z = pose[:3, :3] @ ball_scene.BALLS[number - 1] + pose[:3, 3]
    u, v = ball_scene.FOCAL * x / z + ball_scene.WIDTH / 2, ball_scene.FOCAL * y / z + ball_scene.HEIGHT / 2
    assert ball_scene.look(pose)[1][int(v), int(u)] == number
    return click(round(u, 1), round(v, 1), view)


ON_BALL, ON_GROUND = click_on_ball(2), click(*GROUND)


@pytest.fixture(scope="module")
def result(counted_balls: Any) -> Path:
    """The folder of a count of apples; its photos show balls, which no test may count on to be figs."""
    return counted_balls.out


@pytest.fixture(scope="module")
def taught(result: Path, tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, subprocess.CompletedProcess[str]]:
    """A folder of words with fig, and what was printed."""
    folder = tmp_path_factory.mktemp("words") / "shared"
    clicks = ["--positive", ON_BALL, "--negative", ON_GROUND]
    texts = ["--notes", "from two clicks", "--licence", "CC0"]
    return folder, teach(result, "--word", "Fig", *clicks, *texts, "--out", folder / "fig.fruitword")


def words_with_fig(taught: tuple[Path, object], folder: Path) -> Path:
    """A copy of the folder of words, to be damaged."""
    shutil.copytree(taught[0], folder)
    return folder


def assert_is_one_line(done: subprocess.CompletedProcess[str], *texts: str) -> None:
    assert done.returncode == 1, done.stdout
    assert len(done.stderr.splitlines()) == 1
    assert done.stderr.startswith("error: ")
    for text in texts:
        assert text in done.stderr


def test_help_names_every_flag_and_an_example_and_exits_with_0() -> None:
    command = [sys.executable, str(ROOT / "scripts" / "teach_word.py"), "--help"]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    flags = ("--word", "--positive", "--negative", "--fruit", "--not-fruit", "--boxes", "--masks", "--start", "--out")
    assert all(flag in done.stdout for flag in flags)
    assert "teach_word.py results/tree7 --word fig" in done.stdout


def test_a_missing_word_is_wrong_usage_and_exits_with_2(result: Path) -> None:
    assert teach(result, "--positive", ON_BALL).returncode == 2


def test_clicks_teach_a_word_and_a_picture_of_it(taught) -> None:
    folder, done = taught
    assert done.returncode == 0, done.stderr
    assert sorted(path.name for path in folder.iterdir()) == ["fig.fruitword", "fig.jpg"]
    assert "fig: learnt from 1 positive and 1 negative examples" in done.stdout
    assert f'--prompt "fig" --out DIR --words {folder}' in done.stdout
    word = read_word(folder / "fig.fruitword")
    assert (word.name, word.notes, word.licence) == ("fig", "from two clicks", "CC0")
    assert [(each.positive, each.place) for each in word.examples] == [(True, ON_BALL), (False, ON_GROUND)]
    assert len(word.thumbnails) == 2


@pytest.mark.parametrize(
    "name",
    [
        "images/003.png",
        "003",
        "003.png",
    ],
)
def test_the_picture_shows_the_clicked_photo_next_to_what_matches_in_it(
    name: str, result: Path, own_words: Path
) -> None:
    place = ON_BALL.replace("003.png", name)
    assert teach(result, "--word", "fig", "--positive", place).returncode == 0
    with Image.open(own_words / "fig.jpg") as image:
        pixels = np.asarray(image.convert("RGB")).astype(int)
    assert pixels.shape[1] > 2 * ball_scene.WIDTH
    assert ball_scene.HEIGHT < pixels.shape[0] < 2 * ball_scene.HEIGHT
    photo = open_result(result).scene.images[VIEW].pixels().astype(int)
    left = pixels[-ball_scene.HEIGHT :, : ball_scene.WIDTH]
    right = pixels[-ball_scene.HEIGHT :, -ball_scene.WIDTH :]
    assert np.abs(left - photo).mean() < 10.0
    balls = ball_scene.look(ball_scene.poses(16)[VIEW])[1] > 0
    assert right[balls].sum(axis=1).mean() > right[~balls].sum(axis=1).mean() + 100.0


def test_without_out_the_word_goes_into_the_users_folder_which_every_encoder_reads(
    result: Path, own_words: Path
) -> None:
    done = teach(result, "--word", "fig", "--positive", ON_BALL)
    assert done.returncode == 0, done.stderr
    assert sorted(path.name for path in own_words.iterdir()) == ["fig.fruitword", "fig.jpg"]
    assert '--prompt "fig" --out DIR\n' in done.stdout
    assert list(open_encoder(EmbedConfig()).taught) == ["fig"]


def test_a_count_with_the_folder_of_words_finds_the_balls_labels_them_and_records_the_word(
    taught, result: Path, tmp_path: Path
) -> None:
    folder = taught[0]
    done = count(result, tmp_path / "out", "--prompt", "fig", "--words", folder)
    assert done.returncode == 0, done.stderr
    content = json.loads((tmp_path / "out" / "fruits.json").read_text())
    assert {fruit["label"] for fruit in content["fruits"]} == {"fig"}
    centers = np.array([fruit["center"] for fruit in content["fruits"]])
    distances = np.linalg.norm(centers[:, None] - ball_scene.BALLS, axis=2)
    assert sorted(distances.argmin(axis=1).tolist()) == list(range(5))
    assert distances.min(axis=1).max() < 0.05
    assert content["provenance"]["prompts"] == ["fig"]
    assert content["provenance"]["words"] == {"fig": read_word(folder / "fig.fruitword").identity}


def test_the_script_runs_as_a_program_of_its_own(result: Path, own_words: Path) -> None:
    scripts = ROOT / "scripts"
    learn = [scripts / "teach_word.py", result, "--word", "fig", "--fruit", "77"]
    done = subprocess.run([sys.executable, *map(str, learn)], capture_output=True, text=True, check=False)
    assert_is_one_line(done, "has no fruit 77")
    learn = [scripts / "teach_word.py", result, "--word", "fig", "--fruit", "1", "2"]
    done = subprocess.run([sys.executable, *map(str, learn)], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert (own_words / "fig.fruitword").is_file()


def test_a_prompt_that_was_not_taught_is_one_line(result: Path, tmp_path: Path) -> None:
    assert_is_one_line(count(result, tmp_path / "out", "--prompt", "fig"), "does not know the word 'fig'")
    assert not (tmp_path / "out").exists()


def test_counted_fruit_teach_a_word_by_their_numbers(result: Path, own_words: Path) -> None:
    done = teach(result, "--word", "fig", "--fruit", "1", "3", "--negative", ON_GROUND)
    assert done.returncode == 0, done.stderr
    places = [(each.positive, each.place) for each in read_word(own_words / "fig.fruitword").examples]
    assert places == [(False, ON_GROUND), (True, "fruit 1"), (True, "fruit 3")]


def test_a_fruit_without_gaussians_is_one_line(result: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    opened = open_result(result)
    found = [replace(each, members=np.zeros(0, np.int64)) for each in opened.fruit_count.fruits]
    changed = replace(opened, fruit_count=replace(opened.fruit_count, fruits=found))
    monkeypatch.setattr("fruitlangs.engine.open_result.open_result", lambda _: changed)
    assert_is_one_line(teach(result, "--word", "fig", "--fruit", "1"), "Fruit 1 was found in the photos alone")


def test_a_word_can_be_continued_from_its_file(taught, result: Path, own_words: Path) -> None:
    start = taught[0] / "fig.fruitword"
    done = teach(result, "--word", "fig", "--positive", click_on_ball(4), "--start", start)
    assert done.returncode == 0, done.stderr
    word = read_word(own_words / "fig.fruitword")
    assert [each.place for each in word.examples] == [ON_BALL, ON_GROUND, click_on_ball(4)]
    assert (word.notes, word.licence) == ("from two clicks", "CC0")


def test_boxes_and_masks_teach_a_word(result: Path, own_words: Path, tmp_path: Path) -> None:
    ids = ball_scene.look(ball_scene.poses(16)[VIEW])[1]
    rows, columns = np.nonzero(ids == 2)
    corners = f"{columns.min()},{rows.min()},{columns.max() + 1},{rows.max() + 1}"
    table = tmp_path / "boxes.csv"
    table.write_text(f"image,xmin,ymin,xmax,ymax,label\n003.png,{corners},fig\n003.png,0,60,50,96,leaf\n")
    (tmp_path / "masks").mkdir()
    Image.fromarray((255 * (ids > 0)).astype(np.uint8)).save(tmp_path / "masks" / "003.png")
    done = teach(result, "--word", "fig", "--boxes", table, "--masks", tmp_path / "masks")
    assert done.returncode == 0, done.stderr
    examples = read_word(own_words / "fig.fruitword").examples
    assert [each.positive for each in examples][:2] == [True, False]
    assert any(each.place.startswith("003.png, area") for each in examples)


@pytest.mark.parametrize(
    ("word", "arguments", "text"),
    [
        ("fig", [], "positive example"),
        ("fig", ["--negative", ON_GROUND], "positive example"),
        ("the", ["--positive", ON_BALL], "'the' has no meaning"),
        ("red", ["--positive", ON_BALL], "'red' describes fruit"),
        ("fruit", ["--positive", ON_BALL], "'fruit' stands for several"),
        ("../fig", ["--positive", ON_BALL], "'../fig' cannot be the name of a word"),
        ("a/fig", ["--positive", ON_BALL], "'a/fig' cannot be the name of a word"),
        ("C:\\fig", ["--positive", ON_BALL], "cannot be the name of a word"),
        ("", ["--positive", ON_BALL], "cannot be the name of a word"),
        ("fig", ["--positive", "999.png:5,5"], "No photo is named '999.png'"),
        ("fig", ["--positive", "003.png"], "place in a photo. Write PHOTO:X,Y"),
        ("fig", ["--positive", click(ball_scene.WIDTH + 1, 5)], "128x96 pixels, so 129,5 lies outside"),
        ("fig", ["--positive", click(5, -1)], "lies outside"),
        ("fig", ["--fruit", "77"], "has no fruit 77"),
        ("fig", ["--positive", ON_BALL, "--not-fruit", "0"], "has no fruit 0"),
        ("fig", ["--positive", ON_BALL, "--start", "gone.fruitword"], "gone.fruitword holds no taught word"),
        ("fig", ["--boxes", "gone.csv"], "gone.csv cannot be read"),
        ("fig", ["--masks", "gone"], "gone has no mask pictures"),
        ("fig", ["--positive", ON_BALL, "--negative", ON_BALL], "they look the same"),
    ],
)
def test_what_cannot_be_taught_is_one_line_and_writes_nothing(
    word: str, arguments: list[str], text: str, result: Path, own_words: Path
) -> None:
    assert_is_one_line(teach(result, "--word", word, *arguments), text)
    assert not own_words.exists()


def click_on_nothing(result: Path) -> str:
    """A pixel of the sky in which training left no Gaussian."""
    opened = open_result(result)
    gaussians = opened.gaussians
    solid = [getattr(gaussians, name).numpy() for name in ("means", "scales", "quats", "opacities")]
    for view, camera in enumerate(opened.scene.cameras):
        depth = ball_scene.look(camera.world_to_camera)[2]
        for row, column in np.argwhere(depth == 0.0)[::3]:
            if pick_surface(*ray_through(camera, column + 0.5, row + 0.5), *solid) is None:
                return click(column + 0.5, row + 0.5, view)
    raise AssertionError("Gaussians cover the whole sky")


def test_a_click_on_the_empty_sky_is_one_line(result: Path, own_words: Path) -> None:
    place = click_on_nothing(result)
    assert_is_one_line(teach(result, "--word", "fig", "--positive", place), place, "shows nothing")
    assert not own_words.exists()


def test_out_must_have_the_name_of_the_word(result: Path, tmp_path: Path) -> None:
    out = tmp_path / "new" / "plum.fruitword"
    done = teach(result, "--word", "fig", "--positive", ON_BALL, "--out", out)
    assert_is_one_line(done, "must be named fig.fruitword")
    assert not out.parent.exists()


def test_a_start_of_another_word_is_one_line(taught, result: Path, own_words: Path) -> None:
    done = teach(result, "--word", "date", "--positive", ON_BALL, "--start", taught[0] / "fig.fruitword")
    assert_is_one_line(done, "of the word 'fig', not of 'date'")
    assert not own_words.exists()


def test_a_folder_without_a_result_is_one_line(tmp_path: Path) -> None:
    assert_is_one_line(teach(tmp_path, "--word", "fig", "--fruit", "1"), str(tmp_path))


def damaged(file: Path) -> None:
    file.write_bytes(file.read_bytes()[:200])


def of_another_encoder(file: Path) -> None:
    word: TaughtWord = read_word(file)
    save_word(file, replace(word, encoder_id="embedded-0123456789abcdef"))


def of_another_name(file: Path) -> None:
    save_word(file, replace(read_word(file), name="date"))


@pytest.mark.parametrize(
    ("spoil", "text"),
    [
        (damaged, "holds no taught word"),
        (of_another_encoder, "was taught with the encoder embedded-0123456789abcdef"),
        (of_another_name, "holds the word 'date'"),
    ],
)
def test_a_word_that_cannot_be_used_is_one_line_only_where_it_is_asked_for(
    spoil, text: str, taught, result: Path, tmp_path: Path
) -> None:
    folder = words_with_fig(taught, tmp_path / "words")
    spoil(folder / "fig.fruitword")
    asked = count(result, tmp_path / "out", "--prompt", "fig", "--words", folder)
    assert_is_one_line(asked, text, "fig.fruitword")
    assert not (tmp_path / "out").exists()
    assert count(result, tmp_path / "out", "--prompt", "mango", "--words", folder).returncode == 0


@pytest.mark.parametrize("spoil", [damaged, of_another_encoder])
def test_teaching_does_not_continue_from_a_word_that_cannot_be_used(
    spoil, taught, result: Path, own_words: Path, tmp_path: Path
) -> None:
    folder = words_with_fig(taught, tmp_path / "words")
    spoil(folder / "fig.fruitword")
    done = teach(result, "--word", "fig", "--positive", ON_BALL, "--start", folder / "fig.fruitword")
    assert_is_one_line(done)
    assert not own_words.exists()


@pytest.fixture
def without_photos(result: Path, tmp_path: Path) -> Path:
    """A copy of the result whose photos are gone."""
    folder = shutil.copytree(result, tmp_path / "result", ignore=shutil.ignore_patterns("cache"))
    content = json.loads((folder / "fruits.json").read_text())
    content["provenance"]["source"] = "/gone/photos"
    (folder / "fruits.json").write_text(json.dumps(content))
    return folder


def test_a_click_where_the_photos_are_gone_is_one_line(without_photos: Path, own_words: Path) -> None:
    done = teach(without_photos, "--word", "fig", "--positive", ON_BALL)
    assert_is_one_line(done, "photos of this result are missing")
    assert not own_words.exists()


def test_counted_fruit_teach_a_word_also_where_the_photos_are_gone(without_photos: Path, own_words: Path) -> None:
    done = teach(without_photos, "--word", "fig", "--fruit", "1")
    assert done.returncode == 0, done.stderr
    assert (own_words / "fig.fruitword").is_file()
