"""Calibration of cameras from pictures of a board."""
