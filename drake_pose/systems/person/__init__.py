"""The capture of a person by all silhouettes at once, recorded or live."""
