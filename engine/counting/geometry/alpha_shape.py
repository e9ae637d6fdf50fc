"""The volume of the alpha shape of points: what a ball of a given radius cannot enter."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import Delaunay, QhullError

FloatArray = NDArray[np.float64]


def alpha_shape_volume(points: FloatArray, radius: float) -> float:
    """Volume of the Delaunay tetrahedra of points (M, 3) whose circumsphere is smaller than `radius`.

    The radius is in the unit of the points, the volume in its cube (Edelsbrunner and Mücke 1994). 0 for fewer than
    four points and for points in one plane. An infinite radius gives the convex hull.

    Raises:
        ValueError: a point is not finite.
    """
    if len(points) < 4:
        return 0.0
    points = points - points.mean(axis=0)
    try:
        simplices = Delaunay(points).simplices
    except QhullError:
        return 0.0
    corners = points[simplices]
    a, b, c = np.moveaxis(corners[:, 1:] - corners[:, :1], 1, 0)
    bc, ca, ab = np.cross(b, c), np.cross(c, a), np.cross(a, b)
    sixfold = np.abs(_dots(a, bc))
    # The circumcentre is `toward` / (2 · sixfold); a sliver's is too far away to divide.
    toward = _dots(a, a)[:, None] * bc + _dots(b, b)[:, None] * ca + _dots(c, c)[:, None] * ab
    kept = (sixfold > 0.0) & (np.linalg.norm(toward, axis=1) < 2.0 * radius * sixfold)
    return float(sixfold[kept].sum() / 6.0)


def _dots(left: FloatArray, right: FloatArray) -> FloatArray:
    products: FloatArray = np.einsum("ti,ti->t", left, right)
    return products
