"""The visible contour of a projected body, as edges and as points."""
