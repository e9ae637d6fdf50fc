"""Photos on disk: pixels, resampling and lens models."""
