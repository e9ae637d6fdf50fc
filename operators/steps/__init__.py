"""The steps from photos to a counted result."""
