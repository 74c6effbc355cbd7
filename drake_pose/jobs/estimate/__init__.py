"""A scene in, a pose a frame out."""
