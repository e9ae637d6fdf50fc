"""Many trees in one Blender scene, and the review of each."""
