"""A picture of a taught word: the photos with its examples, and what it matches in them."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path, PurePosixPath

from PIL import Image
from torch import Tensor

from ..scene.camera import Scene
from ..splatting.gaussians import Gaussians
from ..splatting.rendering.rasterize import render
from ..storage.files import replace_file
from .pictures import join_side_by_side, ramp, strip_views

MOST_VIEWS = 4
"""Photos in a picture."""


def save_word_picture(
    path: Path, scene: Scene, gaussians: Gaussians, probability: Tensor, places: Sequence[str]
) -> None:
    """Write a JPEG of the first photos in which examples lie, else of some spread over the scene. probability: (N,) of
    the word; places: where its examples came from. The scene has its photos.

    Raises:
        OutputError: it cannot be written.
    """
    clicked = {place.rpartition(":")[0] for place in places}
    names = [(photo.name, PurePosixPath(photo.name)) for photo in scene.images]
    named = [view for view, (name, path) in enumerate(names) if {name, path.name, path.stem} & clicked]
    strips = []
    for view in (named or strip_views(scene))[:MOST_VIEWS]:
        drawn = render(gaussians, scene.cameras[view], features=probability[:, None])
        assert drawn.features is not None
        shown = drawn.features[..., 0].detach().numpy()
        name = scene.images[view].name
        pixels = scene.images[view].pixels()
        strips.append(join_side_by_side({f"photo {name}": pixels, "probability of the word": ramp(shown)}))
    page = Image.new("RGB", (max(each.width for each in strips), sum(each.height for each in strips)), (255, 255, 255))
    top = 0
    for strip in strips:
        page.paste(strip, (0, top))
        top += strip.height
    with replace_file(path) as temporary:
        page.save(temporary, format="JPEG", quality=90)
