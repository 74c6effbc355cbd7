"""Pictures of silhouettes: mask files, scenes, and Drake's label images."""
