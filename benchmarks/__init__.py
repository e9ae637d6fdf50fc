"""Measurements of speed, and what the project is measured against. Not part of the installed package."""
