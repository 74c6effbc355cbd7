"""One person from all silhouettes at once: fit, shape, tracking, recovery after a loss."""
