"""The pose tree: joints and links as a graph, each node's pose and skin by its joint values."""
