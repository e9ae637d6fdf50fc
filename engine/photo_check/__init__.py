"""A check of the photos before a long run: blur, gaps, exposure, cameras, and what the run will cost."""
