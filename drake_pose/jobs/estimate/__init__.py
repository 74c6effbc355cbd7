"""Estimates of the poses of a scene: inputs, search or tracking, comparison, and records."""
