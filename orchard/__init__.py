"""Synthetic orchards: a fruit tree built and rendered in Blender, with the truth about every fruit."""
