"""Selected Gaussians → `FruitCount` (paper section 3.3)."""
