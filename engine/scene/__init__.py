"""Photos, cameras and sparse models → `Scene`."""
