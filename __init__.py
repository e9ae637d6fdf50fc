# SPDX-License-Identifier: GPL-3.0-or-later
"""FruitLangs counts fruit from photos of trees: a Python package and a Blender extension."""

__version__ = "1.0.0-rc.1"


def register() -> None:
    """Called by Blender when the extension is enabled."""
    from .fruitlangs_addon import registration

    registration.register()


def unregister() -> None:
    """Called by Blender when the extension is disabled."""
    from .fruitlangs_addon import registration

    registration.unregister()
