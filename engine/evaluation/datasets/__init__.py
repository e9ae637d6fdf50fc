"""Readers of published data sets with ground truth."""
