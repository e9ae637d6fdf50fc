"""What other operators need of a 3D viewport: appearance, Geometry Nodes, splats as arrays, ray hits."""
