"""Silhouettes: projected areas by the span kernel, Drake label images, masks and scenes."""
