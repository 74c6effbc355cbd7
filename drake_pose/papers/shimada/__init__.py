"""Shimada's synthetic experiment with the two-finger hand."""
