"""Refinement of placed photos: longer tracks, bundle adjustment, and photos that were placed wrongly or not at all."""
