"""Cameras found from photos alone (structure from motion)."""
