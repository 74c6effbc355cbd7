"""Silhouettes in, poses out: Kameda's search and wider ones, no Drake framework in them."""
