"""Prepares what the user gives as a scene: photos without cameras get them first."""

from __future__ import annotations

import functools
import os
import shutil
import uuid
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path

from ..config import PhotosConfig, SceneConfig
from ..errors import OutputError, SceneError
from ..progress import Progress, silent
from ..storage.files import file_hash, files_hash, text_hash
from ..storage.keys import stage_key
from .camera import Scene
from .formats.layout import find_model
from .formats.transforms import TRANSFORMS
from .read import SceneFiles, open_scene, read_scene
from .sfm.find_cameras import find_poses, list_photos


@dataclass(eq=False, kw_only=True)
class Source:
    """A scene on disk: the model is read and checked once, and every file is hashed once.

    path: its folder or transforms.json; images, masks: folders of a COLMAP model's photos and masks that are elsewhere;
    notices: messages for the user; reused: the model was in the cache.
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
        return read_scene(self.path, config, opened=self.opened(progress), progress=progress)

    def opened(self, progress: Progress = silent) -> SceneFiles:
        """The model or transforms.json, checked; errors as of `open_scene`."""
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
        for file in self.opened().files():
            groups[next((folder for folder in apart if file.is_relative_to(folder)), root)].append(file)
        parts = [self._hash(files, folder) for folder, files in groups.items()]
        return text_hash(*parts) if apart else parts[0]

    def _hash(self, files: Sequence[Path], root: Path) -> str:
        try:
            return files_hash(files, root, self._hash_of)
        except OSError as error:
            raise SceneError(f"{error.filename} cannot be read ({error.strerror}). Check its permissions") from error

    def photos_alone(self) -> Path | None:
        """The folder of the photos (`path`/images or `path`) if they have no cameras; else None.

        Raises:
            SceneError: a model is there and is incomplete.
        """
        path = self.path
        if not path.is_dir() or (path / TRANSFORMS).is_file() or find_model(path) is not None:
            return None
        return next((folder for folder in (path / "images", path) if list_photos(folder)), None)

    def posed(self, cache: Path, config: PhotosConfig, *, progress: Progress = silent) -> Source:
        """The source itself if its photos have cameras; else its photos with cameras that are estimated
        (`find_poses`), or taken from `cache`, where they are stored by the content of the photos.

        Masks are in `masks` next to the photos' folder or inside it.

        Raises:
            SceneError: as `find_poses`.
            OutputError: `cache` cannot be written.
            Cancelled: `progress` asked for it.
        """
        photos = self.photos_alone()
        if photos is None:
            return self
        model = self._model(photos, cache, config)
        found = find_poses(photos, model.path.parent, config, progress=progress)
        return replace(model, path=found.model, notices=found.notices, reused=found.reused)

    def has_poses(self, cache: Path, config: PhotosConfig) -> bool:
        """Whether the cameras of photos alone are in `cache`."""
        photos = self.photos_alone()
        return photos is not None and self._model(photos, cache, config).path.is_dir()

    def posed_before(self, earlier: Path, cache: Path, config: PhotosConfig) -> Source:
        """As `posed`, with the cameras of an earlier run in the cache `earlier`; they are copied to `cache`.

        Raises:
            SceneError: they are not there, or the photos have changed.
            OutputError: `cache` cannot be written.
        """
        photos = self.photos_alone()
        if photos is None:
            return self
        source, kept = self._model(photos, earlier, config), self._model(photos, cache, config)
        if not source.path.is_dir():
            raise SceneError(f"The cameras of {photos} are no longer in {earlier}. Count again from the photos")
        if not kept.path.is_dir():
            staging = kept.path.with_name(f".model.{uuid.uuid4().hex}")
            try:
                shutil.copytree(source.path, staging)
                os.replace(staging, kept.path)
            except OSError as error:
                raise OutputError(f"{cache} cannot be written ({error.strerror or error})") from error
        return kept

    def _model(self, photos: Path, cache: Path, config: PhotosConfig) -> Source:
        """The photos with their model in `cache`, whether it exists or not."""
        try:
            library = version("pycolmap")
        except PackageNotFoundError as error:
            raise SceneError("The package pycolmap is missing. Run: python -m pip install pycolmap") from error
        key = stage_key(("scene",), self._hash(list_photos(photos), photos), config, library)
        # Otherwise they are where a model's masks are expected.
        masks = photos / "masks" if (photos / "masks").is_dir() else None
        return Source(path=cache / f"photos-{key}" / "model", images=photos, masks=masks, _hash_of=self._hash_of)
