"""Cameras: points in the world to pixels, and camera files.

Pixel centres are at integers (the OpenCV convention). A camera frame C has x to the right, y down
and z forward.
"""
