"""The check of a folder of photos, before the long run."""

from __future__ import annotations

from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from tempfile import TemporaryDirectory

from ..child_process import usable_cores
from ..config import Config
from ..errors import SceneError
from ..language.encoders.encoder import sees_whole
from ..language.features.embedder import Embedder
from ..memory import available_bytes
from ..photo_size import choose_some, fruit_width
from ..progress import Progress, part, silent
from ..scene.pycolmap_import import colmap_library
from ..scene.source import Source
from . import findings
from .cost import estimate_costs, side_read
from .examine import Examined, examine, read_reduced
from .finding import CheckedPhoto, PhotoCheck
from .links import Links, find_links
from .photo_files import PhotoFiles, is_video, list_photo_files
from .sharpness import relative_sharpness

MOST_THREADS = 4
"""Photos are decoded in this many threads at most, which limits the memory."""


def check_photos(
    source: Path | Source,
    config: Config = Config(),  # noqa: B008 (frozen)
    *,
    free: int | None = None,
    progress: Progress = silent,
) -> PhotoCheck:
    """Check photos, or stills of a video, for blur, gaps, exposure and mixed cameras, and estimate time and memory.

    Each photo is read once, at a reduced size, and nothing is written. A file that cannot be read is a finding, not an
    error. free: usable bytes of memory, `available_bytes` if not given.

    Raises:
        SceneError: there are no photos, the video cannot be used, the model of their cameras cannot be read, or
            pycolmap is missing.
        Cancelled: `progress` asked for it.
    """
    source = source if isinstance(source, Source) else Source(path=source)
    _require_colmap()
    if not is_video(source):
        return _check(source, config, free, progress)
    with TemporaryDirectory() as folder:
        stills = source.stills(Path(folder), progress=part(progress, 0.0, 0.5))
        return _check(stills, config, free, part(progress, 0.5, 1.0))


def _check(source: Source, config: Config, free: int | None, progress: Progress) -> PhotoCheck:
    """The check of photos in a folder."""
    files = list_photo_files(source)
    examined = _examine_all(files.photos, part(progress, 0.0, 0.6))
    photos = {path: each for path, each in examined.items() if isinstance(each, Examined)}
    unreadable = {files.name(path): str(each) for path, each in examined.items() if isinstance(each, Exception)}
    names, readable = [files.name(path) for path in photos], list(photos.values())
    links = find_links([photo.features for photo in readable], progress=part(progress, 0.6, 0.9))
    sizes = [(photo.width, photo.height) for photo in readable]
    share = fruit_share([photo.path for photo in readable], config, part(progress, 0.9, 1.0))
    costs = estimate_costs(sizes, config, posed=files.posed, fruit=share)
    found = [
        *findings.check_files(files, unreadable),
        *findings.check_number(len(readable)),
        *findings.check_overlap(names, readable, links),
        *findings.check_sharpness(names, readable),
        *findings.check_light(names, readable, links),
        *findings.check_cameras(names, readable),
        *findings.check_fruit(share, sizes, config),
        *findings.check_memory(costs, available_bytes() if free is None else free),
    ]
    progress(1.0, "photos checked")
    return PhotoCheck(
        folder=files.folder,
        photos=_list_checked(files, readable, links),
        findings=sorted(found, key=lambda finding: finding.severity != "problem"),
        costs=costs,
    )


def fruit_share(photos: Sequence[Path], config: Config, progress: Progress) -> float | None:
    """The width of fruit in some of the photos, as a share of the longer side; None if they show few, or if the encoder
    does not process whole photos."""
    encoder = Embedder.open(config.embed).encoder
    if not photos or not sees_whole(encoder):
        return None
    progress(0.0, "Measuring the width of fruit in a few photos")
    pixels = [read_reduced(photos[index], lambda side: side_read(side, config)) for index in choose_some(len(photos))]
    return fruit_width(pixels, [max(each.shape) for each in pixels], encoder)


def _require_colmap() -> None:
    """Import pycolmap in this thread, before several threads use it.

    Raises:
        SceneError: it is not installed.
    """
    try:
        colmap_library()
    except ImportError as error:
        raise SceneError(
            f"The check needs the package pycolmap ({error}). Run: python -m pip install pycolmap"
        ) from error


def _examine_all(paths: Sequence[Path], progress: Progress) -> dict[Path, Examined | SceneError]:
    """Each photo, or why it cannot be read."""
    found: dict[Path, Examined | SceneError] = {}
    with ThreadPoolExecutor(min(usable_cores(), MOST_THREADS)) as pool:
        try:
            for done, (path, each) in enumerate(zip(paths, pool.map(_try_examine, paths), strict=True), start=1):
                progress(done / len(paths), f"reading photo {done} of {len(paths)}")
                found[path] = each
        except BaseException:
            pool.shutdown(cancel_futures=True)
            raise
    return found


def _try_examine(path: Path) -> Examined | SceneError:
    try:
        return examine(path)
    except SceneError as error:
        return error


def _list_checked(files: PhotoFiles, readable: Sequence[Examined], links: Links) -> list[CheckedPhoto]:
    """List all photos in order, also those that cannot be read."""
    shares = relative_sharpness([photo.sharpness for photo in readable])
    index = {photo.path: number for number, photo in enumerate(readable)}
    degrees = dict(links.graph.degree)
    return [
        CheckedPhoto(
            name=files.name(path),
            sharpness=shares[index[path]],
            brightness=readable[index[path]].brightness,
            links=degrees[index[path]],
            thumbnail=readable[index[path]].thumbnail,
        )
        if path in index
        else CheckedPhoto(name=files.name(path))
        for path in files.photos
    ]
