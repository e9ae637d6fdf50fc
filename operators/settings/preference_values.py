"""The values of the extension's preferences for settings that the scene leaves at their defaults."""

from __future__ import annotations

import dataclasses
from typing import TYPE_CHECKING, Any

import bpy

from ..package_folder import EXTENSION

if TYPE_CHECKING:
    from ...engine.config import EmbedConfig

CHECKPOINTS = ("clip", "sam")
"""The settings of `EmbedConfig` that name a checkpoint; the preferences have folders with the same names."""


def preferences() -> Any:
    """The extension's preferences; None if it was registered by a script and not enabled."""
    addon = bpy.context.preferences.addons.get(EXTENSION)
    return None if addon is None else addon.preferences


def add_preferred_folders(embed: EmbedConfig) -> EmbedConfig:
    """Return the settings with the preferences' checkpoints for those that the scene left at their defaults."""
    preferred, defaults = preferences(), type(embed)()
    if preferred is None:
        return embed
    untouched = [name for name in CHECKPOINTS if getattr(embed, name) == getattr(defaults, name)]
    folders = {name: getattr(preferred, name) for name in untouched}
    given = {name: bpy.path.abspath(folder) for name, folder in folders.items() if folder}
    return dataclasses.replace(embed, **given)
