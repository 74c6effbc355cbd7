"""Pose and mask in turn: an object found in colour pictures by its own model."""
