"""Surfaces as triangles: meshes, mesh files, Drake's primitive shapes, the file of a skin."""
