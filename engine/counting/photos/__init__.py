"""Fruit that the photos show, whether Gaussians represent them or not."""
