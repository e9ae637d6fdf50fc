"""What the Gaussians show: the subject's extent, the ground, and viewpoints around it."""
