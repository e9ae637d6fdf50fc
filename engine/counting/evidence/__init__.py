"""Evidence for each fruit: surface points, visibility, candidate spheres and the gate that weighs them."""
