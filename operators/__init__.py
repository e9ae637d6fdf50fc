"""What Blender does: operators and writers from engine values to Blender data."""
