"""Date's stages as Drake systems, and their diagram."""
