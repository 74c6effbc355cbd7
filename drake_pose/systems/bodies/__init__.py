"""Bodies in a diagram's SceneGraph that stand as given positions say, with their skin."""
