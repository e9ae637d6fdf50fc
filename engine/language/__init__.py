"""`Gaussians` → features → probability of a prompt (paper sections 3.2 and 3.3)."""
