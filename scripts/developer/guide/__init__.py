"""Controls Blender's window by simulated events, for the pictures of the user guide and for tests."""
