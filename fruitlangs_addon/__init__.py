"""The user interface in Blender: properties, panels, preferences, and the list of classes."""
