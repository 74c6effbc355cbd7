"""Date's experiment: a simulated person before many cameras."""
