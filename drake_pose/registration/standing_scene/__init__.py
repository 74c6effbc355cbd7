"""Cameras on a link, registered from whatever stands still in their pictures."""
