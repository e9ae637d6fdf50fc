"""`Scene` → `Gaussians` (paper section 3.1)."""
