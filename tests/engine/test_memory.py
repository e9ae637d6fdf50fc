"""The memory that a run needs is known before it starts."""

from __future__ import annotations

import platform
from pathlib import Path

import numpy as np
import psutil
import pytest
from PIL import Image

from fruitlangs.engine import memory
from fruitlangs.engine.compiled.heap import release_freed
from fruitlangs.engine.config import Config, CountConfig, EmbedConfig, SceneConfig, TrainConfig
from fruitlangs.engine.errors import ConfigError
from fruitlangs.engine.memory import (
    available_bytes,
    camera_search_bytes,
    camera_search_threads,
    require_memory,
    stage_bytes,
    training_bytes,
)
from fruitlangs.engine.pipeline import count_scene
from fruitlangs.engine.scene.camera import Camera


def cameras(count: int, width: int, height: int) -> list[Camera]:
    return [Camera(K=np.eye(3), world_to_camera=np.eye(4), width=width, height=height)] * count


def test_a_job_has_no_more_memory_than_its_batch_system_gives_it(tmp_path: Path) -> None:
    job = tmp_path / "groups" / "slurm" / "job_7"
    (job / "task").mkdir(parents=True)
    for folder, limit in ((job, "5000000"), (job / "task", "max")):
        (folder / "memory.max").write_text(limit + "\n")
        (folder / "memory.current").write_text("3000000\n")
        (folder / "memory.stat").write_text("anon 2000000\ninactive_file 1000000\n")
    own = tmp_path / "own"
    own.write_text("0::/slurm/job_7/task\n")
    assert available_bytes(tmp_path / "groups", own) == 3_000_000
    assert available_bytes(tmp_path / "groups", tmp_path / "missing") > 10_000_000


@pytest.mark.parametrize(("encoder", "count"), [("clip", 100), ("embedded", 40)])
def test_a_training_that_does_not_fit_is_refused_with_what_would_fit(encoder: str, count: int) -> None:
    views = cameras(count, 800, 600)
    config = Config(train=TrainConfig(sh_degree=3), embed=EmbedConfig(encoder=encoder))  # type: ignore[arg-type]
    needed = max(stage_bytes(200_000, config, views, trained=True).values())
    assert training_bytes(200_000, 3, views) <= needed < 2.6 * 2**30
    require_memory(200_000, config, views, trained=True, free=needed)
    with pytest.raises(ConfigError, match=r"^Training with up to 2,000,000 .*--train.max-gaussians \d+"):
        require_memory(2_000_000, config, views, trained=True, free=needed)
    with pytest.raises(ConfigError, match=r"--scene.downscale"):
        require_memory(200_000, config, views, trained=True, free=1 << 28)


def test_every_stage_is_checked_and_the_largest_is_named() -> None:
    few = cameras(2, 1600, 1200)
    stages = stage_bytes(1000, Config(), few, trained=True)
    assert list(stages) == ["training", "computing features", "counting"]
    with pytest.raises(ConfigError, match=r"^Computing features with .* 2 photos of up to 1600×1200 needs about"):
        require_memory(1000, Config(), few, trained=True, free=max(stages.values()) - 1)
    # Views are drawn smaller, photos beyond a limit are read from disk, and features are of one photo at a time.
    many, more, row = (
        stage_bytes(1000, Config(), cameras(count, 1600, 1200), trained=True) for count in (300, 900, 3000)
    )
    assert max(many.values()) < max(more.values()) * 1.01
    assert {stage: row[stage] - many[stage] for stage in many if stage != "counting"} == {
        "training": 0,
        "computing features": 0,
    }
    assert row["counting"] - many["counting"] < 2100 * 2_500_000  # a row of so many photos keeps small views of all
    clip = Config(embed=EmbedConfig(encoder="clip"))
    alone = [stage_bytes(1000, clip, cameras(count, 1600, 1200), trained=True)["counting"] for count in (300, 3000)]
    assert alone[1] - alone[0] < 2100 * 1_300_000


def test_of_photos_above_the_encoders_pixels_only_decoding_needs_more_memory_for_features() -> None:
    config = Config(scene=SceneConfig(max_side=0))
    here, there = (stage_bytes(1000, config, cameras(9, *size), trained=False) for size in ((4000, 3000), (8000, 6000)))
    assert there["computing features"] - here["computing features"] < 13 * (8000 * 6000 - 4000 * 3000)


def test_counting_needs_more_memory_if_fruit_are_searched_in_the_photos() -> None:
    searched, alone = (
        stage_bytes(70_000, Config(embed=EmbedConfig(encoder=encoder)), cameras(80, 960, 720), trained=False)
        for encoder in ("embedded", "clip")
    )
    assert alone["counting"] < 2.2 * 2**30 < 2.9 * 2**30 < searched["counting"] < 3.3 * 2**30  # 3053 MB were measured


def test_later_stages_need_more_after_a_training_which_leaves_part_of_the_photos_in_memory() -> None:
    views = cameras(100, 800, 600)
    alone, after = (stage_bytes(1000, Config(), views, trained=trained) for trained in (False, True))
    photos = 4 * 100 * 800 * 600
    assert all(150 * 2**20 + 0.4 * photos < after[stage] - alone[stage] < 150 * 2**20 + photos for stage in alone)


@pytest.mark.parametrize("encoder", ["embedded", "clip"])
def test_more_gaussians_need_more_memory_in_every_stage(encoder: str) -> None:
    config = Config(embed=EmbedConfig(encoder=encoder), count=CountConfig())  # type: ignore[arg-type]
    few, many = (stage_bytes(n, config, cameras(9, 800, 600), trained=True) for n in (10_000, 1_000_000))
    assert all(few[stage] < many[stage] for stage in few)


def test_a_run_that_does_not_fit_is_refused_before_the_first_step(few_photos: Path, tmp_path: Path) -> None:
    huge = Config(train=TrainConfig(max_gaussians=100_000_000, steps=10**6))
    with pytest.raises(ConfigError, match=r"GB are free\. Close other programs, or use --train\.max-gaussians"):
        count_scene(few_photos, ["fruit"], tmp_path, config=huge)


def test_a_run_that_does_not_fit_names_the_size_of_a_photo_that_exists() -> None:
    mixed = [*cameras(2, 800, 600), *cameras(2, 500, 700)]
    with pytest.raises(ConfigError, match="photos of up to 800×600 needs"):
        require_memory(10**6, Config(), mixed, trained=True, free=1)


def test_a_camera_search_that_does_not_fit_is_refused_with_a_size_that_would() -> None:
    sizes = [(4000, 3000)] * 60
    with pytest.raises(ConfigError, match=r"cameras of 60 photos needs about .* --photos\.max-side (\d+)") as caught:
        camera_search_threads(sizes, 1600, cores=16, free=1 << 30)
    smaller = int(str(caught.value).split()[-1])
    assert camera_search_threads(sizes, smaller, cores=16, free=1 << 30) >= 1


def test_a_camera_search_uses_as_many_cores_as_memory_allows() -> None:
    sizes = [(4000, 3000)] * 60
    assert camera_search_threads(sizes, 1600, cores=16, free=64 << 30) == 16
    few = camera_search_threads(sizes, 1600, cores=16, free=8 << 30)
    assert 2 <= few < 16
    assert camera_search_bytes(60, 1600 * 1200, few) <= 8 << 30 < camera_search_bytes(60, 1600 * 1200, few + 1)


def test_photos_whose_cameras_cannot_be_found_in_memory_are_refused_first(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "tree").mkdir()
    for number in range(3):
        Image.new("RGB", (64, 48)).save(tmp_path / "tree" / f"{number}.jpg")
    monkeypatch.setattr(memory, "available_bytes", lambda: 1 << 20)
    with pytest.raises(ConfigError, match="Finding the cameras of 3 photos"):
        count_scene(tmp_path / "tree", ["apple"], tmp_path / "out")


@pytest.mark.skipif(platform.libc_ver()[0] != "glibc", reason="only glibc keeps them")
def test_freed_arrays_between_kept_ones_are_returned_to_the_system() -> None:
    process = psutil.Process()
    np.ones(30 << 17)  # once such an array was freed, glibc keeps others of its size
    arrays = [np.ones(30 << 16) for _ in range(40)]
    kept = arrays[::8]
    del arrays
    before = process.memory_info().rss
    release_freed()
    assert before - process.memory_info().rss > 200 << 20
    assert all(array[-1] == 1.0 for array in kept)
