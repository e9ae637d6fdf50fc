"""Stills of a video → photos alone."""
