"""Compiled CPU kernels of the camera search: plain arrays in, plain arrays out."""
