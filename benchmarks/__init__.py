"""Measurements of speed, and baselines. Not part of the installed package."""
