"""The one tool that waits for clicks in a viewport, so that other actions can end it."""

from __future__ import annotations

from typing import Any

# Blender forgets a tool whose class is unregistered without notice, so the one that waits for clicks is kept here.
_waiting: Any = None


def begin_waiting(tool: Any) -> None:
    """Register the tool that waits from now on, instead of any other."""
    global _waiting
    end_waiting()
    _waiting = tool


def end_waiting() -> None:
    """End the tool that waits for clicks, if any; it removes what it showed."""
    global _waiting
    tool, _waiting = _waiting, None
    if tool is not None:
        tool.stop_showing()


def is_waiting(tool: Any) -> bool:
    """Whether it is this tool that waits."""
    return _waiting is tool
