"""Compiled CPU kernels of rendering and training: plain arrays in, plain arrays out."""
