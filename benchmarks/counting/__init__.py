"""Counting alone, on simulated crowns and on scenes."""
