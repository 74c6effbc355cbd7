"""Camera models, camera files, and images, videos and joint logs of recordings.

Pixel centres are at integers (the OpenCV convention). A camera frame C has x to the right, y down
and z forward.
"""
