"""Pose estimation of articulated objects from silhouettes, as Drake systems."""

__version__ = "0.1.0"
