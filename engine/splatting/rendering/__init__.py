"""Views of Gaussians and their gradients, and the float64 reference they are tested against."""
