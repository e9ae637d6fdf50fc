"""Gaussians and coloured points that another program reconstructed."""
