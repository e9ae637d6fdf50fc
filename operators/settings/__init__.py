"""Settings of the panel and the preferences as engine values."""
