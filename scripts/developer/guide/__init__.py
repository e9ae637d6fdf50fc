"""Driving Blender's window by events, as a person does, for the pictures of the user guide and for tests."""
