"""Interactive tools that pick points on the tree."""
