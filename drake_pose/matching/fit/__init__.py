"""The continuous fit: a body's contour drawn to the silhouettes' edges."""
