"""Pictures as Drake systems: simulated cameras, recordings, live cameras."""
