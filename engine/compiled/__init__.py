"""Numba's set-up, and the vector type and thread blocks that every kernel shares."""
