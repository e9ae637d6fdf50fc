"""`FruitCount` → tables, meshes, pictures."""
