"""Features of Gaussians: lifted from photos or masks, or trained as codes (paper section 3.2)."""
