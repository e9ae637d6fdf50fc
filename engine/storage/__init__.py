"""Files, the names of cached outputs, and the lock of a folder."""
