"""Following a body through a sequence of masks."""
