"""Exports of the reviewed result."""
