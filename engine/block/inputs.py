"""What the count of a tree was made from, besides its line of the manifest, and whether that has changed since."""

from __future__ import annotations

import json
import os
from collections.abc import Iterable, Iterator
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

from ..errors import ConfigError, FruitLangsError, SceneError, VocabularyError
from ..language.encoders.open_encoder import folder_of_words
from ..language.taught.library import Library
from ..language.vocabulary import find_taught_name, parse
from ..reconstruction import PHOTOS
from ..report.results import FRUITS_JSON
from ..result_folder import ResultFolder
from ..scene.formats.layout import find_model
from ..scene.formats.transforms import TRANSFORMS, open_transforms
from ..scene.photos.picture_file import RAW_SUFFIXES
from ..scene.sfm.find_cameras import PHOTO_SUFFIXES
from ..scene.video.frames import VIDEO_SUFFIXES
from ..storage.files import text_hash
from ..storage.keys import program_key
from ..training import CAMERAS, FEATURES, GAUSSIANS
from .manifest import TreeEntry, holds_block

READ_SUFFIXES = frozenset({*PHOTO_SUFFIXES, *RAW_SUFFIXES, *VIDEO_SUFFIXES, ".bin", ".txt", ".json", ".ply"})
"""Endings of the files in a source that a count may read."""
OF_RESULT = (FRUITS_JSON, GAUSSIANS, CAMERAS, FEATURES, PHOTOS)
"""The files of an earlier result from which fruit are counted."""
FOLDERS_ABOVE = 3
"""How far above a COLMAP model its folder of photos may lie."""


@dataclass(frozen=True, kw_only=True)
class Inputs:
    """What a count was made from, as hashes: names, sizes and modification times of the files of its source; the same
    of its taught words, its template and the local checkpoints of its encoder; and the code of this program. Empty for
    a count of an earlier version, which did not note them."""

    files: str = ""
    words: str = ""
    program: str = ""


@dataclass(frozen=True, kw_only=True)
class Check:
    """Whether a count is of its present inputs. outdated: it has to be counted again; note: what has changed, or why
    that cannot be checked; empty if nothing has changed."""

    outdated: bool = False
    note: str = ""


def read_inputs(tree: TreeEntry) -> Inputs:
    """The inputs of a tree as they are now; `files` is empty if its source is missing. Files are listed, not read.

    Raises:
        ConfigError: its settings are of another version.
    """
    own = tree.source if tree.source.is_dir() else tree.source.parent
    files = list_source_files(tree.source)
    return Inputs(
        files=_stat_hash(files, own) if files else "",
        words=_stat_hash(_files_of_words(tree), own),
        program=program_key(),
    )


def check_inputs(tree: TreeEntry, before: Inputs) -> Check:
    """Compare the inputs of a count with the present ones. A tree whose source is missing keeps its count: it cannot
    be counted again."""
    try:
        now = read_inputs(tree)
    except ConfigError as error:
        return Check(outdated=True, note=f"its settings are of another version of this program: {error}")
    if not now.files:
        return Check(note=f"its source {tree.source} is missing or empty, so its earlier count is kept unchecked")
    if before == Inputs():
        return Check(outdated=True, note="an earlier version counted it and did not note which files it read")
    changes = {
        "files of its source were added, removed or changed": now.files != before.files,
        "taught words, the template or the checkpoint that it uses have changed": now.words != before.words,
        "another version of this program counted it": now.program != before.program,
    }
    note = "; ".join(text for text, changed in changes.items() if changed)
    return Check(outdated=bool(note), note=note)


def list_source_files(source: Path) -> list[Path]:
    """List the files from which a source is read, in any order; [] if it is missing.

    Of a folder these are all files of a kind that is read, in sub-folders too, except results and blocks, and photos
    elsewhere that its camera model names.
    """
    if source.is_file():
        return [source, *(_list_named(source) if source.suffix.lower() == ".json" else ())]
    if not source.is_dir():
        return []
    if ResultFolder(source).holds_result():
        return [file for file in (source / name for name in OF_RESULT) if file.is_file()]
    found = list(_walk(source, set()))
    if (source / TRANSFORMS).is_file():
        found += _list_named(source / TRANSFORMS)
    return [*found, *(file for folder in _photo_folders_above(source) for file in _walk(folder, set()))]


def _walk(folder: Path, entered: set[str]) -> Iterator[Path]:
    """The files in a folder and its sub-folders that a count may read. entered: folders in which the walk was, so that
    a link to one above ends."""
    real = os.path.realpath(folder)
    if real in entered:
        return
    entered.add(real)
    with suppress(OSError), os.scandir(folder) as entries:
        for entry in entries:
            if entry.name.startswith("."):
                continue
            path = Path(entry.path)
            if entry.is_dir():
                if not holds_block(path) and not ResultFolder(path).holds_result():
                    yield from _walk(path, entered)
            elif path.suffix.lower() in READ_SUFFIXES:
                yield path


def _list_named(transforms: Path) -> list[Path]:
    """List the files that a transforms.json names; none if it cannot be used, of which the count tells the reason."""
    with suppress(SceneError):
        return open_transforms(transforms).files()
    return []


def _photo_folders_above(source: Path) -> list[Path]:
    """Folders of photos and masks of a COLMAP model in `source` that lie above it."""
    try:
        model = find_model(source)
    except FruitLangsError:
        return []
    if model is None:
        return []
    above = [folder / name for folder in model.folder.resolve().parents[:FOLDERS_ABOVE] for name in ("images", "masks")]
    return [folder for folder in above if folder.is_dir() and not folder.is_relative_to(source.resolve())]


def _files_of_words(tree: TreeEntry) -> list[Path]:
    """The files of the taught words that the prompts of a tree name, its template, and the files of the checkpoints of
    its encoder that are folders of this computer."""
    embed, count = tree.config.embed, tree.config.count
    library = Library.of(folder_of_words(embed), "")
    names = {name for phrase in (*tree.prompt, *tree.negative) if (name := _word_of(phrase, library))}
    found = [library.files[name] for name in sorted(names)]
    if count.template:
        found.append(Path(count.template))
    if embed.encoder == "clip":
        folders = [Path(embed.clip), *([Path(embed.sam)] if embed.masks == "sam" else ())]
        found += [file for folder in folders if folder.is_dir() for file in sorted(folder.iterdir())]
    return found


def _word_of(phrase: str, library: Library) -> str:
    """The taught word that a prompt names; empty without one."""
    if name := find_taught_name(phrase, library):
        return name
    try:
        noun = parse(phrase, library).noun
    except VocabularyError:
        return ""
    return noun if noun in library else ""


def _stat_hash(files: Iterable[Path], own: Path) -> str:
    """Hash of names relative to a folder, sizes and modification times of files, in any order."""
    lines = set()
    for file in files:
        try:
            stat = file.stat()
        except (OSError, ValueError):  # it was removed since it was listed, or is no path
            continue
        name = file.relative_to(own) if file.is_relative_to(own) else file
        lines.add(json.dumps([name.as_posix(), stat.st_size, stat.st_mtime_ns]))
    return text_hash(*sorted(lines))
