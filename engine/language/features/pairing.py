"""Cameras with results for their photos, one view at a time."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from typing import TypeVar

from ...errors import SceneError
from ...scene.camera import Camera
from ...scene.photos.photo import same_shape

Given = TypeVar("Given")


def pair_views(
    cameras: Sequence[Camera],
    views: Iterable[Given],
    size_of: Callable[[Given], Sequence[int]],
    what: str,
    *,
    smaller: bool = False,
) -> Iterator[tuple[int, Camera, Given]]:
    """Yield the number of each view, its camera and its `what`, for example "masks", of which none is kept here;
    size_of: its height and width in pixels.

    smaller: views may be evenly scaled down; then the camera is scaled to them.

    Raises:
        SceneError: there are not as many as cameras, one has not its camera's size, or there is no camera.
    """
    given = iter(views)
    for index, camera in enumerate(cameras):
        view = next(given, None)
        if view is None:
            raise SceneError(f"{what} for {index} of {len(cameras)} views were given. Give them for each camera")
        size = tuple(size_of(view))
        height, width = size
        fits = width <= camera.width and height <= camera.height
        if smaller and fits and same_shape(width, height, camera.width, camera.height):
            camera = camera.resize(width, height)
        if size != (camera.height, camera.width):
            raise SceneError(
                f"The {what} of view {index} are {'×'.join(map(str, reversed(size)))} pixels, its camera has "
                f"{camera.width}×{camera.height}. Make them at its size"
            )
        yield index, camera, view
        del view
    if not len(cameras):
        raise SceneError("The scene has no camera. Add at least one photo")
    if next(given, None) is not None:
        raise SceneError(f"{what} for more views than the {len(cameras)} cameras were given. Give them for each camera")
