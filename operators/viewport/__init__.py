"""Functions for 3D viewports: appearance, Geometry Nodes, splats as arrays, ray hits."""
