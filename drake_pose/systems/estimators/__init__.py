"""The matcher, the tracker and the truncated filter as Drake systems, and their diagrams."""
