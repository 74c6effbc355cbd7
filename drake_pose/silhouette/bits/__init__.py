"""Silhouettes as bit masks, one bit a pixel, for searches over very many poses."""
