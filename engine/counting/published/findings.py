"""Result of a template method for a cluster, and all results as clusters of fruit."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..evidence.candidates import SurfaceIndex
from ..evidence.cluster import Clusters
from ..geometry.sphere import weigh_spheres
from .parts import Part, hausdorff

IntArray = NDArray[np.int64]

RADIUS_SD = 0.1
"""Standard deviation of a fruit's radius, in radii, since all have the size of the template."""


@dataclass(frozen=True, eq=False)
class Finding:
    """index: (M,) points of one cluster; parts: its fruit, none if it is dropped; reason: for the audit."""

    index: IntArray
    parts: Sequence[Part]
    reason: str

    @classmethod
    def keep(cls, index: IntArray, volume: float, parts: Sequence[Part]) -> Finding:
        """Keep a cluster of this many template volumes that consists of these fruit."""
        kind = "a compound" if len(parts) > 1 else "a small fruit" if parts[0].small else "a single fruit"
        return cls(
            index,
            parts,
            f"{kind}: its alpha shape has {volume:.2f} template volumes, the Hausdorff distance to the aligned "
            f"{'template is' if len(parts) == 1 else 'templates is on the mean'} {hausdorff(parts):.2f} diameters, "
            f"γ = {len(parts)}",
        )

    @classmethod
    def drop(cls, index: IntArray, reason: str) -> Finding:
        """Drop a cluster without fruit."""
        return cls(index, [], f"{reason}, γ = 0")


def clusters_of(surface: SurfaceIndex, diameter: float, findings: Sequence[Finding]) -> Clusters:
    """The fruit of all clusters of the surface points, each of `diameter` scene units."""
    parts = [part for finding in findings for part in finding.parts]
    owners, components = (
        np.full(len(surface.points), -1, np.int64),
        np.full(len(surface.points), len(findings), np.int64),
    )
    for number, part in enumerate(parts):
        owners[part.index] = number
    for number, finding in enumerate(findings):
        components[finding.index] = number
    centers = np.array([diameter * part.fit.center for part in parts]).reshape(-1, 3)
    radii = np.full(len(parts), diameter / 2.0)
    return Clusters(
        points=surface.points,
        spheres=weigh_spheres(surface.cells, surface.normals, centers, radii, RADIUS_SD * radii),
        owners=owners,
        components=components,
        probabilities=np.array([surface.points.probabilities[part.index].mean() for part in parts]),
        refusals={len(findings): "too thin to be part of any cluster"}
        | {number: finding.reason for number, finding in enumerate(findings) if not finding.parts},
        findings={number: finding.reason for number, finding in enumerate(findings) if finding.parts},
        small=frozenset(number for number, part in enumerate(parts) if part.small),
    )
