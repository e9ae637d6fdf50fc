"""What a camera model does without photos that it lists and that are not there."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from ...errors import SceneError

FEWEST, LEAST_SHARE = 3, 0.5
"""Number of photos, and share of the listed ones, that must be there to go on without the others."""
NAMED = 10
"""Number of missing photos that are named."""


def note_missing(file: Path, missing: Sequence[Path], listed: int) -> list[str]:
    """One note that counts and names the photos that are missing of those that `file` lists; none without any.

    missing: their paths, as listed; listed: number of photos in `file`, those that are there included.

    Raises:
        SceneError: fewer than FEWEST photos are there, or less than LEAST_SHARE of those listed.
    """
    if not missing:
        return []
    found = listed - len(missing)
    if found == 0:
        raise SceneError(f"None of the {listed} photos that {file} lists was found, first {missing[0]}. Put them there")
    counted = f"{len(missing)} of the {listed} photos that {file} lists are missing"
    if found < max(FEWEST, LEAST_SHARE * listed):
        raise SceneError(
            f"{counted}, first {missing[0]}. At least {FEWEST} photos and half of those listed are needed. Put them "
            "there"
        )
    names = ", ".join(path.name for path in missing[:NAMED])
    more = f" and {len(missing) - NAMED} more" if len(missing) > NAMED else ""
    return [f"{counted.replace(str(file), file.name)} and were left out: {names}{more}"]
