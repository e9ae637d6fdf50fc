"""Stand-in."""

from dataclasses import dataclass
from typing import Any


@dataclass(frozen=True, eq=False)
class Splats:
    means: Any
    scales: Any
    quats: Any
    colors: Any
    opacities: Any
    probability: Any


def show_preview(scene: int, splats: "Splats | None", matrix: Any) -> None:
    pass
