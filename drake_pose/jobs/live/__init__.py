"""Capture of a person frame by frame, as pictures come, and the walk through the garden."""
