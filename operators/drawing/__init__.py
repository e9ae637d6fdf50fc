"""What is drawn into viewports: splats, labels and the legend."""
