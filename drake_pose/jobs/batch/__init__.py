"""Many scenes, in chunks, on any number of workers."""
