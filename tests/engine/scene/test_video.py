"""Stills of a video: their number follows the camera's path, and bad videos are errors or notices."""

from __future__ import annotations

import json
import shutil
import weakref
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from films import HEIGHT, WIDTH, picture, turn, write_film, write_sound
from PIL import Image
from scipy.ndimage import gaussian_filter

from fruitlangs.engine.config import PhotosConfig
from fruitlangs.engine.errors import Cancelled, SceneError
from fruitlangs.engine.scene.read import open_scene
from fruitlangs.engine.scene.source import Source
from fruitlangs.engine.scene.video import stills as stills_module
from fruitlangs.engine.scene.video.frames import Frame, Video
from fruitlangs.engine.scene.video.path import Step
from fruitlangs.engine.scene.video.stills import SPACING, Stills, choose_stills, select_stills

LENGTH = 1.5
"""Path of most of the videos, in widths of the picture."""
EXPECTED = LENGTH / SPACING + 1


def pan(rate: int, seconds: float = 3.0, length: float = LENGTH) -> list[np.ndarray]:
    count = round(rate * seconds)
    return [picture(length * index / (count - 1)) for index in range(count)]


def listed(stills: Stills) -> list[dict]:
    return json.loads((stills.images.parent / "stills.json").read_text(encoding="utf-8"))["stills"]


def files(stills: Stills) -> list[Path]:
    return sorted(stills.images.iterdir())


@pytest.fixture(scope="session")
def walk(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A video of 3 s."""
    return write_film(tmp_path_factory.mktemp("film") / "walk.mp4", pan(24), rate=24)


@pytest.fixture(scope="session")
def chosen(walk: Path, tmp_path_factory: pytest.TempPathFactory) -> Stills:
    """The stills of `walk`."""
    return choose_stills(walk, tmp_path_factory.mktemp("cache") / "video-1")


@pytest.mark.parametrize("rate", [10, 24, 60])
def test_the_number_of_stills_follows_the_path_and_not_the_frame_rate(rate: int, tmp_path: Path) -> None:
    video = write_film(tmp_path / "a.mp4", pan(rate), rate=rate)
    assert len(files(choose_stills(video, tmp_path / "out"))) == pytest.approx(EXPECTED, rel=0.1)


def test_the_number_of_stills_does_not_follow_the_speed(tmp_path: Path) -> None:
    video = write_film(tmp_path / "a.mp4", pan(24, seconds=7.0))
    assert len(files(choose_stills(video, tmp_path / "out"))) == pytest.approx(EXPECTED, rel=0.1)


def test_a_pause_with_a_shaking_hand_adds_no_stills(chosen: Stills, tmp_path: Path) -> None:
    frames, shake = pan(24), np.random.default_rng(0)
    rest = [picture(LENGTH / 2 + 0.006 * shake.random()) for _ in range(60)]
    video = write_film(tmp_path / "a.mp4", frames[:36] + rest + frames[36:], rate=24)
    assert abs(len(files(choose_stills(video, tmp_path / "out"))) - len(files(chosen))) <= 1


def test_a_slide_show_gives_every_slide_once(tmp_path: Path) -> None:
    slides = [picture(0.1 * slide) for slide in range(12)]
    video = write_film(tmp_path / "a.mp4", [slide for slide in slides for _ in range(9)])
    found = listed(choose_stills(video, tmp_path / "out"))
    assert [still["frame"] // 9 for still in found] == [*range(12)]


def test_slides_of_unrelated_views_are_kept_once_each(tmp_path: Path) -> None:
    slides = [np.random.default_rng(slide).permutation(picture(0.9 * slide)) for slide in range(6)]
    video = write_film(tmp_path / "a.mp4", [slide for slide in slides for _ in range(9)])
    found = listed(choose_stills(video, tmp_path / "out"))
    assert [still["frame"] // 9 for still in found] == [*range(6)]


def test_a_fast_pan_leaves_no_gap(tmp_path: Path) -> None:
    fast = [picture(0.5 + 0.04 * index) for index in range(25)]
    video = write_film(tmp_path / "a.mp4", [*pan(30, 1.0, 0.5), *fast, *pan(30, 1.0, 0.5)[::-1]], rate=30)
    found = listed(choose_stills(video, tmp_path / "out"))
    inside = [still for still in found if 31 <= still["frame"] < 55]
    assert len(inside) >= 11
    assert max(np.diff([still["frame"] for still in inside])) <= 3


def test_of_neighbouring_frames_the_sharp_one_is_kept(tmp_path: Path) -> None:
    frames = [
        frame if index % 3 == 0 else gaussian_filter(frame, (0, 2, 0)) for index, frame in enumerate(pan(15, 12.0))
    ]
    found = listed(choose_stills(write_film(tmp_path / "a.mp4", frames, rate=15), tmp_path / "out"))
    assert len(found) > 20
    assert [still["frame"] for still in found[:-1] if still["frame"] % 3] == []


def test_stills_have_the_pixels_of_the_video_and_names_in_the_order_of_time(chosen: Stills) -> None:
    found = listed(chosen)
    assert [still["file"] for still in found] == [file.name for file in files(chosen)]
    for still in found[::7]:
        pixels = np.asarray(Image.open(chosen.images / still["file"]))
        assert pixels.shape == (HEIGHT, WIDTH, 3)
        assert np.abs(pixels - picture(LENGTH * still["frame"] / 71).astype(float)).mean() < 8
        assert still["seconds"] == pytest.approx(still["frame"] / 24, abs=0.01)
    assert sum(still["moved"] for still in found) == pytest.approx(LENGTH, rel=0.05)


def test_one_video_gives_the_same_bytes_again(walk: Path, chosen: Stills, tmp_path: Path) -> None:
    again = choose_stills(walk, tmp_path / "out")
    assert [file.read_bytes() for file in files(again)] == [file.read_bytes() for file in files(chosen)]
    assert listed(again) == listed(chosen)


def test_stills_of_a_phone_held_upright_are_upright(tmp_path: Path) -> None:
    video = turn(write_film(tmp_path / "a.mp4", pan(24)))
    first = np.asarray(Image.open(files(choose_stills(video, tmp_path / "out"))[0]))
    assert first.shape == (WIDTH, HEIGHT, 3)
    assert np.abs(first - np.rot90(picture(0.0), -1).astype(float)).mean() < 8


def test_a_variable_frame_rate_changes_the_times_and_not_the_number(chosen: Stills, tmp_path: Path) -> None:
    times = np.cumsum(np.random.default_rng(0).uniform(0.01, 0.09, 72)).tolist()
    video = write_film(tmp_path / "a.mkv", pan(24), times=times)
    found = listed(choose_stills(video, tmp_path / "out"))
    assert len(found) == pytest.approx(len(files(chosen)), rel=0.1)
    assert [still["seconds"] for still in found] == pytest.approx(
        [times[still["frame"]] - times[0] for still in found], abs=0.002
    )


@pytest.mark.parametrize(("transfer", "white", "grey"), [(18, 0.75, 0.38), (16, 0.58, 0.38)])
def test_white_and_grey_of_an_hdr_video_are_white_and_grey(
    transfer: int, white: float, grey: float, tmp_path: Path
) -> None:
    light, dark = (np.full((64, 64, 3), round(65535 * value), np.uint16) for value in (white, grey))
    film = write_film(tmp_path / "a.mp4", [np.hstack([light, dark])] * 3, kind="yuv420p10le", transfer=transfer)
    frame = next(Video(film).frames())
    assert frame.is_hdr
    pixels = frame.pixels().astype(int)
    assert np.ptp(pixels, axis=2).max() <= 3
    assert 225 <= pixels[32, 20, 0] <= 250
    assert 85 <= pixels[32, 100, 0] <= 140


def test_red_of_an_hdr_video_stays_red(tmp_path: Path) -> None:
    red = np.full((64, 64, 3), round(65535 * 0.3), np.uint16)
    red[..., 0] = round(65535 * 0.7)
    pixels = next(Video(write_film(tmp_path / "a.mp4", [red] * 3, kind="yuv420p10le", transfer=18)).frames()).pixels()
    assert pixels[32, 32, 0] > 150
    assert pixels[32, 32, 1:].max() < 90


@pytest.mark.parametrize(
    ("name", "codec"), [("a.mov", "mpeg4"), ("a.m4v", "libx264"), ("a.webm", "libvpx"), ("a.avi", "mjpeg")]
)
def test_common_containers_and_codecs_are_read(name: str, codec: str, tmp_path: Path) -> None:
    kind = "yuvj420p" if codec == "mjpeg" else "yuv420p"
    video = write_film(tmp_path / name, pan(10, 1.0, 0.5), rate=10, codec=codec, kind=kind)
    assert len(files(choose_stills(video, tmp_path / "out"))) >= 8


def test_a_wide_path_gets_fewer_stills_and_a_notice(
    walk: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(stills_module, "MOST_STILLS", 10)
    found = choose_stills(walk, tmp_path / "out")
    assert 9 <= len(files(found)) <= 10
    assert "too long for 10 stills" in found.notices[1]


def test_ten_thousand_frames_give_at_most_300_stills() -> None:
    steps = [Step(index, index / 30, 0.01 * index, 1.0) for index in range(10_000)]
    assert 290 <= len(select_stills(steps)) <= 300


def test_few_frames_are_in_memory_at_a_time(walk: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    alive, most, frames = weakref.WeakSet[Frame](), 0, Video.frames

    def watched(self: Video) -> Iterator[Frame]:
        nonlocal most
        for frame in frames(self):
            alive.add(frame)
            most = max(most, len(alive))
            yield frame
            del frame

    monkeypatch.setattr(Video, "frames", watched)
    choose_stills(walk, tmp_path / "out")
    assert 1 <= most <= 12


def test_a_notice_says_how_many_stills_were_chosen_and_where_they_are(walk: Path, chosen: Stills) -> None:
    (notice,) = chosen.notices
    where = f"{chosen.images.parent.parent.name}/video-1"
    assert notice == f"{len(files(chosen))} stills were chosen from walk.mp4 (3 s); they are in {where}"


def test_finished_stills_are_not_decoded_again(walk: Path, chosen: Stills, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(Video, "frames", lambda self: pytest.fail("decoded"))
    again = choose_stills(walk, chosen.images.parent)
    assert again.reused
    assert again.notices == chosen.notices


def test_stills_of_which_one_was_deleted_are_written_again(walk: Path, chosen: Stills, tmp_path: Path) -> None:
    copy = shutil.copytree(chosen.images.parent, tmp_path / "video-1")
    deleted = next((copy / "images").iterdir())
    deleted.unlink()
    assert not choose_stills(walk, copy).reused
    assert deleted.is_file()


@pytest.mark.parametrize("task", ["following the camera", "writing stills"])
def test_a_cancel_leaves_nothing(task: str, walk: Path, tmp_path: Path) -> None:
    def stop(fraction: float, message: str) -> None:
        if message.startswith(task):
            raise Cancelled

    with pytest.raises(Cancelled):
        choose_stills(walk, tmp_path / "out", progress=stop)
    assert list(tmp_path.iterdir()) == []


def test_progress_never_goes_back(walk: Path, tmp_path: Path) -> None:
    reported: list[float] = []
    choose_stills(walk, tmp_path / "out", progress=lambda fraction, message: reported.append(fraction))
    assert len(reported) > 8
    assert np.all(np.diff(reported) >= 0)


def static(path: Path) -> str:
    noise = np.random.default_rng(0)
    frames = [
        np.clip(picture(0.0) + noise.normal(0, 3, (HEIGHT, WIDTH, 3)), 0, 255).astype(np.uint8) for _ in range(60)
    ]
    write_film(path, frames)
    return r"The camera does not move in .*a\.mp4\. Walk around the tree"


def windy(path: Path) -> str:
    frames = [picture(0.0).copy() for _ in range(60)]
    for index, frame in enumerate(frames):  # the leaves in the middle are new in every frame
        frame[40:, 100:220] = np.random.default_rng(index).permuted(picture(3.0)[40:, 100:220], axis=1)
    write_film(path, frames)
    return "The camera does not move"


def black(path: Path) -> str:
    write_film(path, [np.zeros((HEIGHT, WIDTH, 3), np.uint8)] * 30)
    return "The camera does not move"


def short(path: Path) -> str:
    write_film(path, pan(24, 1.0, 0.07))
    return r"shows only 2 different views"


def sound(path: Path) -> str:
    write_sound(path)
    return r"a\.mp4 has no video stream"


def no_frames(path: Path) -> str:
    write_film(path, pan(24, 0.2))
    content = path.read_bytes()
    start, end = content.index(b"mdat") + 4, content.index(b"moov") - 4
    path.write_bytes(content[:start] + bytes(end - start) + content[end:])
    return r"a\.mp4 has no frame that can be decoded"


def cut_off(path: Path) -> str:
    write_film(path, pan(24, 1.0))
    path.write_bytes(path.read_bytes()[:5000])  # the table of an .mp4 is at its end
    return r"a\.mp4 cannot be read as a video"


def text(path: Path) -> str:
    path.write_text("not a video")
    return r"a\.mp4 cannot be read as a video"


def empty(path: Path) -> str:
    path.touch()
    return r"a\.mp4 cannot be read as a video"


@pytest.mark.parametrize("make", [static, windy, black, short, sound, no_frames, cut_off, text, empty])
def test_a_bad_video_is_one_line_that_says_why_and_leaves_nothing(make, tmp_path: Path) -> None:
    said = make(tmp_path / "a.mp4")
    with pytest.raises(SceneError, match=said) as caught:
        Source(path=tmp_path / "a.mp4").stills(tmp_path / "cache")
    assert "\n" not in str(caught.value)
    assert str(caught.value).count(". ") >= 1
    assert not list(tmp_path.glob("cache/*"))


def test_the_readable_part_of_a_truncated_video_is_used_with_a_notice(tmp_path: Path) -> None:
    video = write_film(tmp_path / "a.mkv", pan(24), rate=24)
    video.write_bytes(video.read_bytes()[: video.stat().st_size // 2])
    found = choose_stills(video, tmp_path / "out")
    assert EXPECTED / 4 < len(files(found)) < 3 * EXPECTED / 4
    assert "a.mkv is incomplete: " in found.notices[1]
    assert "of 3 s were read" in found.notices[1]


def test_damaged_frames_are_left_out_with_a_notice(tmp_path: Path) -> None:
    video = write_film(tmp_path / "a.mov", pan(24), codec="png", kind="rgb24")
    content = bytearray(video.read_bytes())
    middle = len(content) // 2
    content[middle : middle + 3000] = bytes(3000)
    video.write_bytes(content)
    found = choose_stills(video, tmp_path / "out")
    assert len(files(found)) == pytest.approx(EXPECTED, rel=0.1)
    assert found.notices[1] == "a.mov is damaged: some frames could not be decoded and were left out"


def test_a_video_and_a_folder_with_it_alone_give_the_same_photos(walk: Path, tmp_path: Path) -> None:
    shutil.copy(walk, tmp_path / "walk.mp4")
    (tmp_path / "notes.txt").touch()
    file, folder = Source(path=walk), Source(path=tmp_path)
    assert folder.video() == tmp_path / "walk.mp4"
    assert file.is_alone()
    assert folder.is_alone()
    assert file.photos_alone() is None
    one, other = file.stills(tmp_path / "cache"), folder.stills(tmp_path / "cache")
    assert one.path == other.path == one.photos_alone()
    assert not file.has_poses(tmp_path / "cache", PhotosConfig())


def test_photos_come_before_a_video_in_their_folder(walk: Path, tmp_path: Path) -> None:
    shutil.copy(walk, tmp_path)
    Image.new("RGB", (32, 24)).save(tmp_path / "1.jpg")
    assert Source(path=tmp_path).video() is None
    assert Source(path=tmp_path).photos_alone() == tmp_path


def test_two_videos_in_a_folder_are_an_error_that_asks_for_one(walk: Path, tmp_path: Path) -> None:
    for name in ("a.mp4", "b.MOV"):
        shutil.copy(walk, tmp_path / name)
    with pytest.raises(SceneError, match=r"has 2 videos, first a\.mp4\. Give one of them"):
        Source(path=tmp_path).is_alone()


def test_a_video_where_cameras_are_needed_is_named_as_one(walk: Path) -> None:
    with pytest.raises(
        SceneError, match=r"walk\.mp4 is a video without cameras; what is read: a folder of photos, a video"
    ):
        open_scene(walk)
