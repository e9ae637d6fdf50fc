"""Camera paths and single viewpoints."""
