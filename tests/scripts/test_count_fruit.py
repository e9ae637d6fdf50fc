"""The command line for its users: exit codes, one clear line, nothing lost."""

from __future__ import annotations

import dataclasses
import json
import os
import re
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
from PIL import Image

from fruitlangs.engine.config import STAGES
from fruitlangs.engine.setting import Level, level_of

ROOT = Path(__file__).resolve().parents[2]
SAMPLE = ROOT / "examples" / "orchard_tree"
SMALL = ["--scene.downscale", "4", "--train.max-gaussians", "8000", "--no-blend"]
TINY = ["--train.steps", "20", "--train.max-gaussians", "3000", "--train.holdout-every", "0", "--no-blend"]


def command(*arguments: str | Path) -> list[str]:
    return [sys.executable, str(ROOT / "scripts" / "count_fruit.py"), *map(str, arguments)]


def count(*arguments: str | Path, **environment: str) -> subprocess.CompletedProcess[str]:
    environment = {**os.environ, **environment}
    return subprocess.run(
        command(*arguments), capture_output=True, text=True, errors="replace", check=False, env=environment
    )


def copy_of_sample(folder: Path) -> Path:
    shutil.copytree(SAMPLE, folder, ignore=shutil.ignore_patterns("instances", "truth.json"))
    return folder


def truncate(path: Path, share: float) -> None:
    content = path.read_bytes()
    path.write_bytes(content[: int(len(content) * share)])


def flags(text: str) -> set[str]:
    return set(re.findall(r"^  (--[a-z.-]+)", text, re.MULTILINE))


def settings_of(*levels: Level) -> set[str]:
    return {
        f"--{stage}.{field.name.replace('_', '-')}"
        for stage, config in STAGES.items()
        for field in dataclasses.fields(config)
        if level_of(field) in levels
    }


def test_help_fits_on_a_page_of_60_lines_and_shows_the_common_settings() -> None:
    done = count("--help")
    assert done.returncode == 0
    assert len(done.stdout.splitlines()) <= 60
    assert {flag for flag in flags(done.stdout) if "." in flag} == settings_of("common")
    assert {"--prompt", "--out", "--negative", "--preset", "--gaussians", "--help-all"} <= flags(done.stdout)


def test_help_into_a_reader_that_ends_early_is_no_traceback() -> None:
    with subprocess.Popen(command("--help-all"), stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None
        assert process.stderr is not None
        process.stdout.close()
        assert process.stderr.read() == ""
    assert process.returncode == 1


def test_help_all_shows_every_setting_and_the_experimental_ones_in_a_group_of_their_own() -> None:
    ordinary, experimental = count("--help-all").stdout.split("Experimental")
    assert {flag for flag in flags(ordinary) if "." in flag} == settings_of("common", "advanced")
    assert flags(experimental) == settings_of("experimental")


def test_every_placeholder_of_help_is_one_that_the_command_line_accepts(tmp_path: Path) -> None:
    given = ["--train.steps", "7", "--count.box", *["0", "0", "0", "1", "1", "1"], "--units.cameras", "a.jpg", "b.jpg"]
    done = count(str(tmp_path), "--prompt", "apple", "--out", "x", *given)
    assert done.returncode == 1  # the folder is empty and the length is missing; the flags themselves are fine
    assert "--units.cameras has no length" in done.stderr


@pytest.mark.parametrize(
    ("arguments", "given"),
    [
        ("--prompt apple --out x", set()),
        ("--train.steps 1200", {"train.steps"}),
        ("--train.max_gaussians=9 --train.no-exposure", {"train.max_gaussians", "train.exposure"}),
        ("--preset standard", {f"train.{field.name}" for field in dataclasses.fields(STAGES["train"])}),
    ],
)
def test_settings_count_as_given_whatever_their_value(arguments: str, given: set[str]) -> None:
    script = "import sys; sys.path.insert(0, sys.argv[1]); import _checkout; import _terminal\n"
    show = "print(*sorted(_terminal.list_given_settings(sys.argv[2:])))"
    done = subprocess.run(
        [sys.executable, "-c", script + show, str(ROOT / "scripts"), *arguments.split()],
        capture_output=True,
        text=True,
        check=True,
    )
    assert set(done.stdout.split()) == given


CONSOLES = {
    "cp1252": {"PYTHONIOENCODING": "cp1252"},
    "C": {"LC_ALL": "C", "PYTHONCOERCECLOCALE": "0", "PYTHONUTF8": "0"},
}


@pytest.mark.parametrize("script", sorted(path.name for path in (ROOT / "scripts").glob("[!_]*.py")))
def test_help_is_printed_on_a_console_that_lacks_characters(script: str) -> None:
    page = "--help-all" if script == "count_fruit.py" else "--help"
    environment = {**os.environ, **CONSOLES["cp1252"]}
    run = [sys.executable, str(ROOT / "scripts" / script), page]
    done = subprocess.run(run, capture_output=True, check=False, env=environment)
    assert done.returncode == 0, done.stderr
    assert done.stdout.decode("cp1252").strip()
    if page == "--help-all":
        assert b"the paper's tau_pos" in done.stdout


@pytest.mark.parametrize("console", CONSOLES)
def test_a_count_and_its_errors_are_printed_on_consoles_of_any_encoding(console: str, first, tmp_path: Path) -> None:
    again = count(first[0], "--prompt", "apple", "--out", tmp_path / "ö", "--no-blend", **CONSOLES[console])
    assert again.returncode == 0, again.stderr
    assert "visible fruit" in again.stdout
    wrong = count(first[0], "--prompt", "naïve → σ", "--out", tmp_path / "ö", **CONSOLES[console])
    assert wrong.returncode == 1
    assert wrong.stderr.startswith("error: the encoder does not know the word")


def test_a_preset_sets_what_the_flags_of_training_start_from() -> None:
    text = " ".join(count("--preset", "paper", "--help-all").stdout.split())
    assert re.search(r"--train\.steps INT.*?\(default: 30000\)", text)
    assert "(default: 1200)" in " ".join(count("--help").stdout.split())


def test_wrong_usage_exits_with_2() -> None:
    assert count("--no-such-flag").returncode == 2
    assert count("--preset", "fast", "x", "--prompt", "apple", "--out", "y").returncode == 2


def make_missing(folder: Path) -> str:
    return str(folder)


def make_empty_model(folder: Path) -> str:
    copy_of_sample(folder)
    for name, record_count in (("cameras", 0), ("images", 0), ("points3D", 0)):
        (folder / "sparse" / "0" / f"{name}.bin").write_bytes(record_count.to_bytes(8, "little"))
    return "sparse"


def make_without_images(folder: Path) -> str:
    shutil.rmtree(copy_of_sample(folder) / "images")
    return "images"


def make_with_most_images_gone(folder: Path) -> str:
    photos = sorted((copy_of_sample(folder) / "images").iterdir())
    for photo in photos[: len(photos) // 2 + 1]:
        photo.unlink()
    return photos[0].name


def make_with_short_points(folder: Path) -> str:
    truncate(copy_of_sample(folder) / "sparse" / "0" / "points3D.bin", 0.9)
    return "points3D.bin"


def make_with_short_cameras(folder: Path) -> str:
    truncate(copy_of_sample(folder) / "sparse" / "0" / "cameras.bin", 0.9)
    return "cameras.bin"


def make_a_file(folder: Path) -> str:
    folder.write_bytes(b"not a folder")
    return folder.name


@pytest.mark.parametrize(
    "make",
    [
        make_missing,
        make_empty_model,
        make_without_images,
        make_with_most_images_gone,
        make_with_short_points,
        make_with_short_cameras,
        make_a_file,
    ],
)
def test_a_bad_scene_is_one_clear_line_and_exit_1(make, tmp_path: Path) -> None:
    culprit = make(tmp_path / "scene")
    done = count(tmp_path / "scene", "--prompt", "apple", "--out", tmp_path / "out", *SMALL)
    assert done.returncode == 1
    assert len(done.stderr.splitlines()) == 1
    assert done.stderr.startswith("error: ")
    assert culprit in done.stderr
    assert not (tmp_path / "out").exists()


def test_an_absent_checkpoint_is_one_clear_line_under_short_and_long_flags(tmp_path: Path) -> None:
    for prefix in ("--", "--embed."):
        given = ("encoder=clip", "masks=sam", "no-allow-download", "clip=no/clip")
        flags = (prefix + flag for flag in given)
        done = count(SAMPLE, "--prompt", "durian", "--out", tmp_path / "out", *flags)
        assert done.returncode == 1
        assert len(done.stderr.splitlines()) == 1
        assert "'no/clip' is not on this computer" in done.stderr


def test_an_unknown_word_is_one_clear_line_that_names_the_nearest(tmp_path: Path) -> None:
    done = count(SAMPLE, "--prompt", "appel", "--out", tmp_path)
    assert done.returncode == 1
    assert len(done.stderr.splitlines()) == 1
    assert "apple" in done.stderr


def test_an_output_folder_that_cannot_be_written_is_one_clear_line(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("in the way")
    done = count(SAMPLE, "--prompt", "apple", "--out", tmp_path / "file" / "out")
    assert done.returncode == 1
    assert len(done.stderr.splitlines()) == 1
    assert "file" in done.stderr


@pytest.fixture(scope="module")
def first(few_photos: Path, tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, subprocess.CompletedProcess[str]]:
    """The result folder of a real run and what it printed."""
    out = tmp_path_factory.mktemp("first")
    return out, count(few_photos, "--prompt", "fruit", "--out", out, *TINY)


def test_a_count_prints_its_table_and_the_files_it_wrote(first) -> None:
    out, done = first
    assert done.returncode == 0, done.stderr
    assert done.stdout.startswith("fruit: ")
    written = [Path(line.strip()) for line in done.stdout.partition("written:\n")[2].splitlines()]
    assert written[-1] == out / "fruits.json"
    assert len(written) >= 7
    assert all(path.is_file() for path in written)
    assert json.loads((out / "fruits.json").read_text())["provenance"]["prompts"] == ["fruit"]


@pytest.fixture
def masked(balls: Path, tmp_path: Path) -> Path:
    """The balls with masks that leave out the top of each photo."""
    folder = shutil.copytree(balls, tmp_path / "masked")
    document = json.loads((folder / "transforms.json").read_text())
    (folder / "masks").mkdir()
    for frame in document["frames"]:
        frame["mask_path"] = frame["file_path"].replace("images", "masks")
        photo = Image.open(folder / frame["file_path"])
        mask = Image.new("L", photo.size, 255)
        mask.paste(0, (0, 0, photo.width, photo.height // 8))
        mask.save(folder / frame["mask_path"])
    (folder / "transforms.json").write_text(json.dumps(document))
    return folder


def test_a_count_emits_no_warning_of_any_library(masked: Path, tmp_path: Path) -> None:
    settings = ["--train.steps", "150", "--train.max-gaussians", "3000", "--count.threshold", "0.3", "--no-blend"]
    done = count(masked, "--prompt", "apple", "--out", tmp_path / "out", *settings, PYTHONWARNINGS="error")
    assert done.returncode == 0, done.stderr
    assert "Warning" not in done.stderr
    assert done.stdout.startswith("apple: ")


def with_quality(first: Path, out: Path, psnr: float, ssim: float) -> Path:
    """A copy of a result whose held-out photos were reproduced that well."""
    shutil.copytree(first, out)
    content = json.loads((out / "fruits.json").read_text())
    content["provenance"]["training"] |= {"psnr": psnr, "ssim": ssim, "reduced_psnr": psnr, "reduced_ssim": ssim}
    (out / "fruits.json").write_text(json.dumps(content))
    return out


def test_the_quality_of_the_reconstruction_is_printed(first, tmp_path: Path) -> None:
    out = with_quality(first[0], tmp_path / "out", 21.5, 0.71)
    done = count(out, "--prompt", "fruit", "--out", out, "--no-blend")
    assert done.returncode == 0, done.stderr
    assert "held-out photos: PSNR 21.50 dB, SSIM 0.710" in done.stdout


def test_a_0_of_a_poor_reconstruction_is_one_clear_line_and_the_old_result_stays(first, tmp_path: Path) -> None:
    out = with_quality(first[0], tmp_path / "out", 12.0, 0.31)
    before = (out / "fruits.json").read_bytes()
    done = count(out, "--prompt", "mango", "--out", out, "--no-blend", "--count.threshold", "0.999")
    assert done.returncode == 1
    assert done.stderr.startswith("error: The 0 for mango is not a count: held-out photos are reproduced poorly")
    assert len(done.stderr.splitlines()) == 1
    assert (out / "fruits.json").read_bytes() == before


@pytest.mark.parametrize("scene", ["photos", "result"])
def test_a_second_prompt_says_what_it_reused(first, few_photos: Path, scene: str, tmp_path: Path) -> None:
    out = shutil.copytree(first[0], tmp_path / "out")
    done = count(few_photos if scene == "photos" else out, "--prompt", "leaf", "--out", out, *TINY)
    assert done.returncode == 0, done.stderr
    assert "reused from an earlier run: train, embed" in done.stdout


def test_a_scene_blend_is_written_where_bpy_is(first, tmp_path: Path) -> None:
    pytest.importorskip("bpy")
    done = count(first[0], "--prompt", "apple", "--out", tmp_path)
    assert done.returncode == 0, done.stderr
    assert str(tmp_path / "scene.blend") in done.stdout
    assert (tmp_path / "scene.blend").stat().st_size > 0
    assert json.loads((tmp_path / "fruits.json").read_text())["unhashed_files"] == ["scene.blend"]


def test_a_bpy_that_cannot_be_imported_costs_the_blend_and_says_why(first, tmp_path: Path) -> None:
    (tmp_path / "bpy.py").write_text('raise ImportError("libX11.so.6 is missing")')
    done = count(first[0], "--prompt", "apple", "--out", tmp_path / "out", PYTHONPATH=str(tmp_path))
    assert done.returncode == 0, done.stderr
    assert "scene.blend is not written" in done.stderr
    assert "libX11.so.6 is missing" in done.stderr
    assert not (tmp_path / "out" / "scene.blend").exists()


def test_pictures_that_cannot_be_made_are_reported_at_the_end(first, tmp_path: Path) -> None:
    out = shutil.copytree(first[0], tmp_path / "out")
    content = json.loads((out / "fruits.json").read_text())
    content["provenance"]["source"] = "/gone/photos"
    (out / "fruits.json").write_text(json.dumps(content))
    done = count(out, "--prompt", "apple", "--out", out, "--no-blend")
    assert "note: no pictures were made: The photos at /gone/photos are missing" in done.stdout


@pytest.mark.skipif("FRUITLANGS_BLENDER" not in os.environ, reason="set FRUITLANGS_BLENDER to a Blender program")
def test_blender_runs_the_same_script(first, tmp_path: Path) -> None:
    blender = [os.environ["FRUITLANGS_BLENDER"], "-b", "--factory-startup", "--python-exit-code", "1", "-P"]
    arguments = [*command(first[0], "--prompt", "apple", "--out", tmp_path)[1:]]
    done = subprocess.run(
        [*blender, arguments[0], "--", *arguments[1:]], capture_output=True, text=True, check=False, timeout=300
    )
    assert done.returncode == 0, done.stdout + done.stderr
    assert "apple: " in done.stdout
    assert (tmp_path / "scene.blend").is_file()


def wait_for_checkpoint(out: Path, process: subprocess.Popen[str]) -> None:
    """Until training has written a checkpoint."""
    for _ in range(1200):
        if list(out.glob("cache/train-*/checkpoint*")):
            return
        assert process.poll() is None, process.communicate()[1]
        time.sleep(0.1)
    raise AssertionError("no checkpoint appeared")


@pytest.mark.parametrize(("sent", "expected"), [(signal.SIGINT, 130), (signal.SIGTERM, 130), (signal.SIGKILL, -9)])
def test_a_stopped_training_leaves_earlier_results_and_a_checkpoint(sent: int, expected: int, tmp_path: Path) -> None:
    (tmp_path / "fruits.json").write_text("earlier")
    arguments = command(SAMPLE, "--prompt", "apple", "--out", tmp_path, *SMALL, "--train.steps", "20000")
    process = subprocess.Popen(arguments, stderr=subprocess.PIPE, stdout=subprocess.PIPE, text=True)
    wait_for_checkpoint(tmp_path, process)
    os.kill(process.pid, sent)
    process.communicate(timeout=60)
    assert process.returncode == expected
    assert (tmp_path / "fruits.json").read_text() == "earlier"
    assert [path.name for path in tmp_path.iterdir()].count("gaussians.ply") == 0
