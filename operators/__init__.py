"""Operators, and writers of engine values to Blender data."""
