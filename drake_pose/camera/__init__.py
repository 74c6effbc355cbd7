"""Cameras: points in the world to pixels, and camera files.

Pixel centres are at integers (the OpenCV convention). A camera frame C has x to the right, y down
and z forward.
"""

from drake_pose.camera.files import load_cameras, save_cameras
from drake_pose.camera.models import Camera, ParallelCamera, PinholeCamera

__all__ = ["Camera", "ParallelCamera", "PinholeCamera", "load_cameras", "save_cameras"]
