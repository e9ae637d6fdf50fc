"""Counting in a reconstruction of another program, with the photos' cameras and without any."""

from __future__ import annotations

import json
import math
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from clouds import write_cloud
from splats import drawn_scene, random_gaussians

from fruitlangs.engine.config import Config, CountConfig, SceneConfig, TrainConfig
from fruitlangs.engine.errors import ConfigError, OutputError, SceneError
from fruitlangs.engine.pipeline import Result, count_scene
from fruitlangs.engine.scene.camera import Scene
from fruitlangs.engine.splatting.gaussians import Gaussians
from fruitlangs.engine.splatting.imported.imported_gaussians import import_gaussians
from fruitlangs.engine.splatting.ply import read_ply, write_ply
from fruitlangs.engine.splatting.subject import viewpoints
from fruitlangs.engine.storage.files import file_hash

TINY = Config(
    train=TrainConfig(steps=200, max_gaussians=8000),
    count=CountConfig(threshold=0.2, diameter=0.08, sample_budget=3000),
)


@pytest.fixture(scope="module")
def trained(few_photos: Path, tmp_path_factory: pytest.TempPathFactory) -> Result:
    return count_scene(few_photos, ["fruit"], tmp_path_factory.mktemp("trained"), config=TINY)


@pytest.fixture(scope="module")
def file(trained: Result, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """What the training made, as a .ply with nothing around it."""
    return Path(shutil.copy(trained.out / "gaussians.ply", tmp_path_factory.mktemp("imported") / "tree.ply"))


@pytest.fixture
def few_small_views(monkeypatch: pytest.MonkeyPatch) -> None:
    for name, value in (("VIEWS", 6), ("WIDTH", 120), ("HEIGHT", 90)):
        monkeypatch.setattr(viewpoints, name, value)


def document(out: Path) -> dict:
    return json.loads((out / "fruits.json").read_text(encoding="utf-8"))


def test_own_gaussians_that_are_imported_count_as_trained_ones_to_the_byte(
    trained: Result, file: Path, few_photos: Path, tmp_path: Path
) -> None:
    given = count_scene(few_photos, ["fruit"], tmp_path, imported=file, config=TINY)
    for name in ("gaussians.ply", "features.safetensors", "cameras.json", "fruits.csv", "fruits.glb", "fruits.ply"):
        assert (given.out / name).read_bytes() == (trained.out / name).read_bytes(), name
    assert document(given.out)["audit"] == document(trained.out)["audit"]


def test_a_file_alone_is_counted_in_and_the_result_is_complete(
    file: Path, few_small_views: None, tmp_path: Path
) -> None:
    result = count_scene(file, ["fruit"], tmp_path, config=TINY)
    names = ("gaussians.ply", "features.safetensors", "cameras.json", "fruits.csv", "fruits.glb", "fruits.ply")
    assert all((tmp_path / name).is_file() for name in names)
    assert len(list((tmp_path / "pictures").glob("view_drawn_*.png"))) == 4
    assert len(result.scene.cameras) == 6
    assert document(tmp_path)["provenance"]["imported"] == {
        "file": file.name, "sha256": file_hash(file), "kind": "gaussians", "cameras": "placed"
    }  # fmt: skip
    assert any("6 cameras were placed around tree.ply" in notice for notice in result.notices)


def test_another_prompt_needs_neither_the_file_nor_another_lifting(
    file: Path, few_small_views: None, tmp_path: Path
) -> None:
    alone = Path(shutil.copy(file, tmp_path / "alone.ply"))
    first = count_scene(alone, ["fruit"], tmp_path / "first", config=TINY)
    again = count_scene(alone, ["leaf"], tmp_path / "first", config=TINY)
    assert again.reused == ["import", "embed"]
    assert [told for told in again.notices if "diameter" not in told] == first.notices[:2]
    alone.unlink()
    asked = count_scene(tmp_path / "first", ["leaf"], tmp_path / "asked", config=TINY)
    assert document(asked.out)["fruits"] == document(again.out)["fruits"]
    assert document(asked.out)["provenance"]["imported"] == document(again.out)["provenance"]["imported"]
    assert "photos.safetensors" not in document(asked.out)["files"]  # renders show nothing that Gaussians leave out
    for picture in (again.out / "pictures").iterdir():
        assert (asked.out / "pictures" / picture.name).read_bytes() == picture.read_bytes()


def test_a_result_of_an_earlier_version_names_its_import_by_the_former_key(
    file: Path, few_small_views: None, tmp_path: Path
) -> None:
    first = count_scene(file, ["fruit"], tmp_path / "first", config=TINY)
    stored = document(first.out)
    record = stored["provenance"].pop("imported")
    stored["provenance"]["foreign"] = record
    (first.out / "fruits.json").write_text(json.dumps(stored), encoding="utf-8")
    asked = count_scene(first.out, ["leaf"], tmp_path / "asked", config=TINY)
    assert document(asked.out)["provenance"]["imported"] == record
    assert (asked.out / "pictures").is_dir()


def test_a_given_up_direction_is_that_of_the_result(file: Path, few_small_views: None, tmp_path: Path) -> None:
    config = replace(TINY, scene=SceneConfig(up=(0.0, 3.0, 4.0)))
    result = count_scene(file, ["fruit"], tmp_path, config=config)
    np.testing.assert_allclose(result.scene.up, [0.0, 0.6, 0.8])
    assert not any("--scene.up" in notice for notice in result.notices)
    assert count_scene(tmp_path, ["leaf"], tmp_path / "leaf", config=config).config.scene == config.scene


def test_a_place_where_the_file_would_be_overwritten_is_refused(few_photos: Path, file: Path) -> None:
    before = file.read_bytes()
    with pytest.raises(OutputError, match=r"tree\.ply"):
        count_scene(few_photos, ["fruit"], file.parent, imported=file)
    with pytest.raises(OutputError, match="another folder"):
        count_scene(file, ["fruit"], file.parent)
    assert file.read_bytes() == before


def test_a_source_with_its_own_gaussians_takes_no_others(trained: Result, file: Path, tmp_path: Path) -> None:
    for source in (trained.out, file):
        with pytest.raises(ConfigError, match="own Gaussians"):
            count_scene(source, ["fruit"], tmp_path / "out", imported=file)


def made_scene() -> tuple[Scene, Gaussians]:
    """Photos of Gaussians from all around, and these Gaussians (as `drawn_scene` makes them)."""
    gaussians = random_gaussians(60, 0, 5, log_scale=-1.7)
    gaussians.opacity_logits.add_(2.0)
    return drawn_scene(), gaussians


def moved(gaussians: Gaussians, path: Path, *, turn: float = 0.0, shift: float = 0.0) -> Path:
    """The Gaussians' .ply after a turn about y, in radians, and a shift along y."""
    rotation = torch.tensor(
        [[math.cos(turn), 0.0, math.sin(turn)], [0.0, 1.0, 0.0], [-math.sin(turn), 0.0, math.cos(turn)]]
    )
    write_ply(path, replace(gaussians, means=gaussians.means @ rotation.T + torch.tensor([0.0, shift, 0.0])))
    return path


def test_a_reconstruction_in_the_frame_of_the_photos_is_taken(tmp_path: Path) -> None:
    scene, gaussians = made_scene()
    taken = import_gaussians(moved(gaussians, tmp_path / "g.ply"), scene, "hash", SceneConfig(), tmp_path / "cache")
    assert torch.equal(read_ply(taken.folder / "gaussians.ply").means, gaussians.means)
    assert taken.record["cameras"] == "given"


def test_a_reconstruction_that_the_cameras_do_not_see_is_an_error(tmp_path: Path) -> None:
    scene, gaussians = made_scene()
    with pytest.raises(SceneError, match=r"next to nothing of .*g\.ply.*frames differ"):
        import_gaussians(
            moved(gaussians, tmp_path / "g.ply", shift=300.0), scene, "hash", SceneConfig(), tmp_path / "cache"
        )
    assert not (tmp_path / "cache").exists()


def test_a_reconstruction_that_looks_otherwise_than_the_photos_is_an_error(tmp_path: Path) -> None:
    scene, gaussians = made_scene()
    with pytest.raises(SceneError, match=r"g\.ply looks no more like the photos.*frames differ"):
        import_gaussians(
            moved(gaussians, tmp_path / "g.ply", turn=2.2), scene, "hash", SceneConfig(), tmp_path / "cache"
        )


def test_coloured_points_in_the_frame_of_the_photos_are_counted_in(
    trained: Result, few_photos: Path, tmp_path: Path
) -> None:
    gaussians = read_ply(trained.out / "gaussians.ply")
    solid = gaussians.opacities > 0.3
    cloud = write_cloud(
        tmp_path / "cloud.ply", gaussians.means[solid].numpy(), (255 * gaussians.base_colors[solid]).numpy()
    )
    result = count_scene(few_photos, ["fruit"], tmp_path / "out", imported=cloud, config=TINY)
    kept = document(result.out)["provenance"]["imported"]
    assert (kept["kind"], kept["cameras"]) == ("points", "given")
    assert len(read_ply(result.out / "gaussians.ply")) == int(solid.sum())
