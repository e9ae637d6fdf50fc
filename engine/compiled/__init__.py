"""Numba's configuration, and the vector type and thread blocks that all kernels share."""
