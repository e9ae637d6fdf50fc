"""Engine values written to Blender data, and read back."""
