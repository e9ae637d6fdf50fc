"""Matches of placed photos: which are compared, and how many of their features."""

from __future__ import annotations

import contextlib
import sqlite3
import types
from pathlib import Path
from typing import cast

import numpy as np
import pytest

from fruitlangs.engine.config import PhotosConfig
from fruitlangs.engine.progress import silent
from fruitlangs.engine.scene.pycolmap_import import colmap_library
from fruitlangs.engine.scene.sfm.features import Features
from fruitlangs.engine.scene.sfm.job import Job
from fruitlangs.engine.scene.sfm.refining import guided
from fruitlangs.engine.scene.sfm.refining.guided import find_near_pairs, make_database, match_all_guided


def placed(degrees: float) -> types.SimpleNamespace:
    """A photo on a circle around the origin that looks at it."""
    angle = np.radians(degrees)
    turn = np.array([[np.cos(angle), 0, -np.sin(angle)], [0, 1, 0], [np.sin(angle), 0, np.cos(angle)]])
    pose = colmap_library().Rigid3d(colmap_library().Rotation3d(turn), np.array([0.0, 0.0, 4.0]))
    return types.SimpleNamespace(cam_from_world=lambda: pose, projection_center=lambda: -turn.T @ [0.0, 0.0, 4.0])


def test_photos_are_matched_again_with_similar_views_only() -> None:
    pairs = find_near_pairs({position: placed(20.0 * position) for position in range(18)})
    assert {(i, i + 1) for i in range(17)} <= set(pairs)
    assert all(min(j - i, 18 - j + i) <= 2 for i, j in pairs)


@pytest.mark.parametrize(("photos", "count"), [(10, 5000), (200, 3250), (1000, 2048)])
def test_the_more_photos_the_fewer_features_of_each_become_points(
    photos: int, count: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    sizes = np.arange(5000, dtype=np.float32)
    features = [Features(np.zeros((5000, 2), np.float32), sizes, np.zeros((5000, 128), np.uint8))] * photos
    monkeypatch.setattr(guided, "match_guided", lambda _, __, chosen, *___: chosen)
    chosen = match_all_guided(cast(Job, None), features, None, silent)
    assert len(chosen) == photos
    assert all(np.array_equal(each, np.arange(5000 - count, 5000)) for each in chosen)


def test_what_a_killed_run_left_of_its_database_does_not_reach_the_next_one(tmp_path: Path) -> None:
    job = Job(folder=str(tmp_path), photos=[], config=PhotosConfig(), threads=1)
    job.open_database().close()
    refined = tmp_path / "refined.db"
    with contextlib.closing(sqlite3.connect(refined)) as running:
        running.execute("PRAGMA journal_mode=WAL")
        running.execute("CREATE TABLE cameras (number INTEGER)")
        running.commit()
        journals = {path: path.read_bytes() for path in tmp_path.glob("refined.db-*")}
    for path, content in journals.items():
        path.write_bytes(content)
    make_database(job)
    with contextlib.closing(colmap_library().Database.open(refined)) as database:
        assert database.num_images() == 0
