"""Shapes and points: spheres, ellipsoids, neighbour search, matching, random streams."""
