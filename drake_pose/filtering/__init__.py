"""Kalman filters whose estimates satisfy linear inequalities, and trackers built on them."""
