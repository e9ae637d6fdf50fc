"""Panels of the Fruit tab in the 3D viewport's sidebar."""
