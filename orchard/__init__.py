"""Synthetic orchards: a fruit tree generated and rendered in Blender, with the ground truth of every fruit."""
