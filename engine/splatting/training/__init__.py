"""Photos → Gaussians by gradient descent (paper section 3.1)."""
