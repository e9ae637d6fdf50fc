"""What Blender shows: properties, panels, preferences, and the one list of classes."""
