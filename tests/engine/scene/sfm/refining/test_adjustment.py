"""The points that cameras are adjusted to."""

from __future__ import annotations

import numpy as np

from fruitlangs.engine.scene.pycolmap_import import colmap_library
from fruitlangs.engine.scene.sfm.refining.adjustment import keep_most_seen
from fruitlangs.engine.scene.sfm.views import PlacedPhoto, model_of


def test_points_that_adjust_cameras_reach_the_edges_of_the_photos() -> None:
    middle = [(30.0 + column, 30.0 + row) for column in range(20) for row in range(20)]
    edge = [(float(x), y) for x in range(5, 80, 10) for y in (5.0, 75.0)]
    camera = colmap_library().Camera.create_from_model_name(1, "SIMPLE_RADIAL", 90.0, 80, 80)
    pixels = np.array(middle + edge)
    photos = [PlacedPhoto(number, f"{number}", camera, colmap_library().Rigid3d(), pixels) for number in range(1, 5)]
    model = model_of(photos)
    for index in range(len(pixels)):
        track = colmap_library().Track()
        for photo in photos[: 4 if index < len(middle) else 3]:
            track.add_element(photo.number, index)
        model.add_point3D(np.zeros(3), track)
    kept = keep_most_seen(model, 128)
    assert kept.num_points3D() == len(edge) + 2 * 4  # two in each of the four parts of the middle
    assert sum(point.track.length() == 3 for point in kept.points3D.values()) == len(edge)
