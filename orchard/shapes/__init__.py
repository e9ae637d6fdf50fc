"""Plain geometry: wood, fruit bodies, meshes and the ground."""
