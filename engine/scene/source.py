"""Prepares what the user gives as a scene: a video becomes stills, and photos without cameras get them."""

from __future__ import annotations

import functools
import os
import shutil
import uuid
from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass, field, replace
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path

from ..config import PhotosConfig, SceneConfig
from ..errors import OutputError, SceneError
from ..progress import Progress, part, silent
from ..storage.files import file_hash, files_hash, text_hash
from ..storage.keys import stage_key
from .camera import Scene
from .formats.layout import find_model
from .formats.transforms import TRANSFORMS
from .photos.picture_file import RAW_SUFFIXES, explain_raw_refusal, list_files
from .read import SceneFiles, open_scene, read_scene
from .sfm.find_cameras import find_poses, list_photos
from .video.frames import VIDEO_SUFFIXES
from .video.stills import choose_stills


@dataclass(eq=False, kw_only=True)
class Source:
    """A scene on disk: the model is read and checked once, and every file is hashed once.

    path: its folder, transforms.json or video; images, masks: folders of a COLMAP model's photos and masks that are
    elsewhere; notices: messages for the user; reused: the model was in the cache.
    """

    path: Path
    images: Path | None = None
    masks: Path | None = None
    notices: Sequence[str] = ()
    reused: bool = False
    _hash_of: Callable[[Path], str] = field(default_factory=lambda: functools.cache(file_hash), repr=False)
    _opened: SceneFiles | None = field(default=None, init=False, repr=False)

    def __post_init__(self) -> None:
        # A link to a transforms.json names photos next to the link: only its folder is resolved.
        path = Path(self.path)
        self.path = path.resolve() if path.is_dir() else path.parent.resolve() / path.name
        self.images, self.masks = (folder and folder.resolve() for folder in (self.images, self.masks))

    def read(self, config: SceneConfig, progress: Progress = silent) -> Scene:
        """The scene with the headers of its photos; errors as of `read_scene`."""
        return read_scene(self.path, config, opened=self.open(progress), progress=progress)

    def open(self, progress: Progress = silent) -> SceneFiles:
        """Open and check the model or transforms.json; errors as of `open_scene`."""
        if self._opened is None:
            self._opened = open_scene(self.path, images=self.images, masks=self.masks, progress=progress)
        return self._opened

    def hash(self) -> str:
        """SHA-256 over the names and bytes of all files that are read; independent of where they are.

        Names are relative to `path`'s folder, or to `images` and `masks` where these are given.

        Raises:
            SceneError: as `open_scene`, or a file cannot be read.
        """
        apart = [folder for folder in (self.masks, self.images) if folder is not None]
        groups: dict[Path, list[Path]] = {self.path if self.path.is_dir() else self.path.parent: []}
        groups |= {folder: [] for folder in apart}
        root = next(iter(groups))
        for file in self.open().files():
            groups[next((folder for folder in apart if file.is_relative_to(folder)), root)].append(file)
        parts = [self._hash(files, folder) for folder, files in groups.items()]
        return text_hash(*parts) if apart else parts[0]

    def _hash(self, files: Sequence[Path], root: Path) -> str:
        try:
            return files_hash(files, root, self._hash_of)
        except OSError as error:
            raise SceneError(f"{error.filename} cannot be read ({error.strerror}). Check its permissions") from error

    def _file_hash(self, file: Path) -> str:
        return self._hash([file], file.parent)

    def is_alone(self) -> bool:
        """Whether the source is photos or a video without cameras; errors as of `photos_alone` and `video`."""
        return self.photos_alone() is not None or self.video() is not None

    def photos_alone(self) -> Path | None:
        """The folder of the photos (`path`/images or `path`) if they have no cameras; else None, also for a video.

        Raises:
            SceneError: a model is there and is incomplete.
        """
        return None if self._has_model() else self.photos_folder()

    def _has_model(self) -> bool:
        path = self.path
        return path.is_dir() and ((path / TRANSFORMS).is_file() or find_model(path) is not None)

    def photos_folder(self) -> Path | None:
        """`path`/images or `path`, whichever holds photos first; None if neither does."""
        return next((folder for folder in (self.path / "images", self.path) if list_photos(folder)), None)

    def video(self) -> Path | None:
        """The video that the source is: the file itself, or the only one in a folder without photos; else None.

        Raises:
            SceneError: the folder has several videos, or RAW files and no photos.
        """
        path = self.path
        if not path.is_dir():
            return path if path.is_file() and path.suffix.lower() in VIDEO_SUFFIXES else None
        if self._has_model() or self.photos_folder():
            return None
        videos = _files_of(path, VIDEO_SUFFIXES)
        if len(videos) > 1:
            raise SceneError(f"{path} has {len(videos)} videos, first {videos[0].name}. Give one of them as the scene")
        raw = [*_files_of(path / "images", RAW_SUFFIXES), *_files_of(path, RAW_SUFFIXES)]
        if raw and not videos:
            raise SceneError(explain_raw_refusal(raw[0]))
        return videos[0] if videos else None

    def stills(self, cache: Path, *, progress: Progress = silent) -> Source:
        """The stills of a video as photos alone, chosen now or taken from `cache`; the source itself if it is not one.

        Raises:
            SceneError, OutputError, Cancelled: as `choose_stills`.
        """
        video = self.video()
        if video is None:
            return self
        chosen = choose_stills(video, self._stills_folder(video, cache), progress=progress)
        return replace(self, path=chosen.images, notices=[*self.notices, *chosen.notices])

    def _stills_folder(self, video: Path, cache: Path) -> Path:
        """The folder in `cache` of a video's stills, whether it exists or not."""
        key = stage_key(("scene", "compiled"), self._file_hash(video), _version("av"))
        return cache / f"video-{key}"

    def find_poses(
        self, cache: Path, config: PhotosConfig, *, threads: int | None = None, progress: Progress = silent
    ) -> Source:
        """Return the source itself if its photos have cameras; else its photos, or the stills of its video, with
        cameras that are estimated (`find_poses`), or taken from `cache`, where they are stored by the content of the
        photos.

        Masks are in `masks` next to the photos' folder or inside it; threads: as of `find_poses`.

        Raises:
            SceneError: as `stills` and `find_poses`, or there are RAW files without a photo of the same name.
            OutputError: `cache` cannot be written.
            Cancelled: `progress` asked for it.
        """
        start = 0.2 if self.video() else 0.0
        source = self.stills(cache, progress=part(progress, 0.0, start))
        photos = source.photos_alone()
        if photos is None:
            return self
        notices = [*source.notices, *_raw_notices(photos)]
        model = self._model(photos, cache, config)
        found = find_poses(photos, model.path.parent, config, threads=threads, progress=part(progress, start, 1.0))
        return replace(model, path=found.model, notices=[*notices, *found.notices], reused=found.reused)

    def has_poses(self, cache: Path, config: PhotosConfig) -> bool:
        """Whether the cameras of photos alone are in `cache`; False for a video, whose `stills` are asked instead."""
        photos = self.photos_alone()
        return photos is not None and self._model(photos, cache, config).path.is_dir()

    def reuse_poses(self, earlier: Path, cache: Path, config: PhotosConfig) -> Source:
        """Do as `find_poses`, with the cameras of an earlier run in the cache `earlier`; they are copied to `cache`, as
        are the stills of a video, which are chosen again if they were deleted.

        Raises:
            SceneError: they are not there, or the photos have changed.
            OutputError: `cache` cannot be written.
        """
        video = self.video()
        if video is not None:
            _copy_folder(self._stills_folder(video, earlier), self._stills_folder(video, cache))
        photos = self.stills(cache).photos_alone()
        if photos is None:
            return self
        source, kept = self._model(photos, earlier, config), self._model(photos, cache, config)
        if not source.path.is_dir():
            raise SceneError(f"The cameras of {self.path} are no longer in {earlier}. Count again from the photos")
        _copy_folder(source.path, kept.path)
        return kept

    def _model(self, photos: Path, cache: Path, config: PhotosConfig) -> Source:
        """The photos with their model in `cache`, whether it exists or not."""
        key = stage_key(("scene", "compiled"), self._hash(list_photos(photos), photos), config, _version("pycolmap"))
        # Otherwise they are where a model's masks are expected.
        masks = photos / "masks" if (photos / "masks").is_dir() else None
        return Source(path=cache / f"photos-{key}" / "model", images=photos, masks=masks, _hash_of=self._hash_of)


def _files_of(folder: Path, suffixes: Collection[str]) -> list[Path]:
    """The files with these suffixes directly in a folder, in name order; [] if the folder does not exist."""
    return [file for file in list_files(folder, suffixes) if file.is_file()]


def _raw_notices(photos: Path) -> list[str]:
    """Messages about RAW files among photos.

    Raises:
        SceneError: one does not have a photo of the same name.
    """
    raw, stems = _files_of(photos, RAW_SUFFIXES), {photo.stem for photo in list_photos(photos)}
    lone = next((file for file in raw if file.stem not in stems), None)
    if lone is not None:
        raise SceneError(explain_raw_refusal(lone))
    if len(raw) == 1:
        return ["1 RAW file was left out, because a photo of the same name is there"]
    return [f"{len(raw)} RAW files were left out, because photos of the same names are there"] if raw else []


def _version(package: str) -> str:
    """
    Raises:
        SceneError: the package is not installed.
    """
    try:
        return version(package)
    except PackageNotFoundError as error:
        raise SceneError(f"The package {package} is missing. Run: python -m pip install {package}") from error


def _copy_folder(source: Path, target: Path) -> None:
    """Copy a folder atomically, unless it does not exist or the copy does.

    Raises:
        OutputError: the copy cannot be written.
    """
    if target.is_dir() or not source.is_dir():
        return
    staging = target.with_name(f".{target.name}.{uuid.uuid4().hex}")
    try:
        shutil.copytree(source, staging)
        os.replace(staging, target)
    except OSError as error:
        raise OutputError(f"{target.parent} cannot be written ({error.strerror or error})") from error
