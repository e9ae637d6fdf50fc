"""The user's folders on this computer for caches and for downloads."""

from __future__ import annotations

import os
import sys
from pathlib import Path

KERNELS = "kernels-"
"""Prefix of the folders of compiled kernels; a hash of their sources follows."""


def kernels_folder() -> Path:
    """The folder that contains the folders of compiled kernels: $NUMBA_CACHE_DIR, else the user's cache folder."""
    chosen = os.environ.get("NUMBA_CACHE_DIR")
    if chosen:
        return Path(chosen)
    if sys.platform == "win32":
        return _local_data() / "fruitlangs"
    if sys.platform == "darwin":
        return Path.home() / "Library" / "Caches" / "fruitlangs"
    return Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "fruitlangs"


def checkpoints_folder() -> Path:
    """The folder of checkpoints by name: $FRUITLANGS_CHECKPOINTS, else in the user's data folder."""
    chosen = os.environ.get("FRUITLANGS_CHECKPOINTS")
    if chosen:
        return Path(chosen)
    return _data_folder() / "checkpoints"


def words_folder() -> Path:
    """The folder of taught words: $FRUITLANGS_WORDS, else in the user's data folder."""
    chosen = os.environ.get("FRUITLANGS_WORDS")
    return Path(chosen) if chosen else _data_folder() / "words"


def _data_folder() -> Path:
    """The folder of this user for data of FruitLangs."""
    if sys.platform == "win32":
        home = _local_data()
    elif sys.platform == "darwin":
        home = Path.home() / "Library" / "Application Support"
    else:
        home = Path(os.environ.get("XDG_DATA_HOME") or Path.home() / ".local" / "share")
    return home / "fruitlangs"


def _local_data() -> Path:
    """The Windows folder for data of this user on this computer."""
    return Path(os.environ.get("LOCALAPPDATA") or Path.home() / "AppData" / "Local")
