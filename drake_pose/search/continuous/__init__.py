"""Searches whose answer is continuous: a start on the grid or from many places, then the fit."""
