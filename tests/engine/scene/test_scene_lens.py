"""Lenses: every camera model is undone, checked against a pattern painted on the sphere of directions."""

from __future__ import annotations

import numpy as np
import pycolmap
import pytest

from fruitlangs.engine.errors import SceneError
from fruitlangs.engine.scene.photos.lens import Lens, source_map, view_of
from fruitlangs.engine.scene.photos.resample import look_up

SIZE = (160, 120)
LENSES = {
    "SIMPLE_PINHOLE": (100, 80, 60),
    "PINHOLE": (100, 90, 81, 58),
    "SIMPLE_RADIAL": (100, 80, 60, -0.15),
    "SIMPLE_RADIAL_FISHEYE": (70, 80, 60, 0.03),
    "RADIAL": (100, 80, 60, -0.2, 0.05),
    "RADIAL_FISHEYE": (70, 80, 60, 0.03, -0.01),
    "OPENCV": (100, 95, 79, 62, -0.2, 0.04, 0.01, -0.008),
    "OPENCV_FISHEYE": (70, 72, 80, 60, 0.03, -0.01, 0.002, 0.001),
    "FULL_OPENCV": (100, 95, 79, 62, -0.2, 0.04, 0.01, -0.008, 0.01, 0.02, 0.01, 0.003),
    "FOV": (80, 82, 80, 60, 0.9),
    "THIN_PRISM_FISHEYE": (70, 72, 80, 60, 0.03, -0.01, 0.004, 0.003, 0.002, 0.001, 0.002, -0.003),
    "RAD_TAN_THIN_PRISM_FISHEYE": (
        *(70, 72, 80, 60, 0.03, -0.01, 0.002, 0.001, 0.0005, 0.0002),
        *(0.004, 0.003, 0.002, 0.001, 0.001, -0.001),
    ),
    "SIMPLE_DIVISION": (100, 80, 60, -0.2),
    "DIVISION": (100, 95, 80, 60, -0.15),
    "SIMPLE_FISHEYE": (70, 80, 60),
    "FISHEYE": (70, 72, 80, 60),
    "EUCM": (80, 82, 80, 60, 0.6, 1.1),
}


def pattern(rays: np.ndarray) -> np.ndarray:
    """(..., 3) smooth values in [0, 1] of directions (..., 3)."""
    unit = rays / np.linalg.norm(rays, axis=-1, keepdims=True)
    return 0.5 + 0.5 * np.sin(8.0 * unit + [0.3, 1.1, 2.0])


def grid(width: int, height: int) -> np.ndarray:
    """(H, W, 2) pixel centres."""
    return np.stack(np.meshgrid(np.arange(width) + 0.5, np.arange(height) + 0.5), axis=2)


def photo_of_pattern(lens: Lens) -> np.ndarray:
    """(H, W, 3) what the lens sees of the pattern, by unprojecting each pixel."""
    pixels = grid(lens.width, lens.height)
    if lens.is_panorama:
        longitude = (pixels[..., 0] / lens.width - 0.5) * 2.0 * np.pi
        latitude = (pixels[..., 1] / lens.height - 0.5) * np.pi
        rays = np.stack(
            [np.sin(longitude) * np.cos(latitude), np.sin(latitude), np.cos(longitude) * np.cos(latitude)], axis=2
        )
    else:
        camera = pycolmap.Camera(
            camera_id=1, model=lens.model, width=lens.width, height=lens.height, params=list(lens.params)
        )
        flat = camera.cam_from_img(pixels.reshape(-1, 2)).reshape(*pixels.shape)
        rays = np.concatenate([flat, np.ones((*flat.shape[:2], 1))], axis=2)
    return pattern(rays).astype(np.float32)


def view_of_pattern(lens: Lens, face: str) -> np.ndarray:
    """(H, W, 3) what the ideal pinhole sees of the pattern, straight from its K and rotation."""
    view = view_of(lens, face, lens.width, lens.height)
    pixels = grid(view.width, view.height)
    rays = (pixels - view.K[:2, 2]) / [view.K[0, 0], view.K[1, 1]]
    rays = np.concatenate([rays, np.ones((*rays.shape[:2], 1))], axis=2)
    return pattern(rays @ view.rotation)


def test_every_model_of_pycolmap_is_tested() -> None:
    assert {*LENSES, "EQUIRECTANGULAR"} == set(pycolmap.CameraModelId.__members__) - {"INVALID"}


@pytest.mark.parametrize("model", LENSES)
def test_undistorted_pattern_is_what_a_pinhole_sees(model: str) -> None:
    lens = Lens(model, LENSES[model], *SIZE)
    source = source_map(lens, "", *SIZE)
    error = np.abs(look_up(photo_of_pattern(lens), source) - view_of_pattern(lens, ""))[source.valid]
    assert source.valid.mean() > 0.6
    assert source.valid[60, 80]
    assert error.max() < 0.012


@pytest.mark.parametrize("face", Lens("EQUIRECTANGULAR", (256.0, 128.0), 256, 128).faces)
def test_cube_face_of_a_panorama_is_what_a_pinhole_sees(face: str) -> None:
    lens = Lens("EQUIRECTANGULAR", (256.0, 128.0), 256, 128)
    source = source_map(lens, face, 256, 128)
    error = np.abs(look_up(photo_of_pattern(lens), source) - view_of_pattern(lens, face))
    assert source.valid.all()
    assert np.percentile(error, 99) < 0.012  # the poles and the seam are one pixel wide


def test_distortion_is_worth_undoing() -> None:
    lens = Lens("OPENCV", LENSES["OPENCV"], *SIZE)
    assert np.abs(photo_of_pattern(lens) - view_of_pattern(lens, "")).max() > 0.2


def test_pixels_that_the_photo_does_not_show_are_not_valid() -> None:
    pincushion = Lens("SIMPLE_RADIAL", (100.0, 80.0, 60.0, 0.4), *SIZE)
    source = source_map(pincushion, "", *SIZE)
    assert not source.valid[0, 0]
    assert source.valid[60, 80]
    assert (look_up(np.ones((120, 160, 1), np.float32), source)[~source.valid] == 0.0).all()


def test_a_lens_that_folds_back_is_cut_at_the_fold() -> None:
    folding = Lens("SIMPLE_RADIAL", (60.0, 80.0, 60.0, -0.25), *SIZE)  # r (1 - r²/4) turns back at r = 1.155
    radius = np.linalg.norm((grid(*SIZE) - [80.0, 60.0]) / 60.0, axis=2)
    valid = source_map(folding, "", *SIZE).valid
    assert not valid[radius > 1.2].any()
    assert valid[radius < 1.1].all()


def test_pinhole_intrinsics_follow_the_resize_exactly() -> None:
    lens = Lens("PINHOLE", (100.0, 90.0, 81.0, 58.0), 160, 120)
    np.testing.assert_allclose(
        view_of(lens, "", 53, 40).K,
        [[100 * 53 / 160, 0, 81 * 53 / 160], [0, 90 * 40 / 120, 58 * 40 / 120], [0, 0, 1]],
    )


def test_a_resized_photo_is_undistorted_alike() -> None:
    lens = Lens("OPENCV", LENSES["OPENCV"], *SIZE)
    whole, half = source_map(lens, "", *SIZE), source_map(lens, "", 80, 60)
    # the centre of a half-size pixel is the corner between four whole ones
    corner = whole.pixels.reshape(60, 2, 80, 2, 2).mean(axis=(1, 3))
    np.testing.assert_allclose(half.pixels * 2.0, corner, atol=0.02)


@pytest.mark.parametrize(
    ("model", "params", "said"),
    [
        ("PINHOLE", (0.0, 90.0, 81.0, 58.0), "focal length"),
        ("PINHOLE", (np.nan, 90.0, 81.0, 58.0), "not finite"),
        ("PINHOLE", (100.0, 81.0, 58.0), "3 parameters"),
        ("TELESCOPE", (100.0, 81.0, 58.0), "TELESCOPE"),
    ],
)
def test_an_impossible_lens_is_named(model: str, params: tuple[float, ...], said: str) -> None:
    with pytest.raises(SceneError, match=said):
        Lens(model, params, 160, 120)
