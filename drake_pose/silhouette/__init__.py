"""Silhouettes: exact projected areas, masks, label images, scenes and segmentation of pictures."""
