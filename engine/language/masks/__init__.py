"""Masks of photos for crop encoders: classical superpixels or SAM."""
