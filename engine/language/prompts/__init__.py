"""Features and a prompt → probability per Gaussian (paper eq. 10 and 11)."""
