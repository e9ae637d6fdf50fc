"""The Python packages that the engine needs, and the caches."""
