"""Estimators, cameras and players as Drake systems, and diagrams built of them."""
