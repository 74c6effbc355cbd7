"""Experiments of the three papers, whose printed figures are compared with ours."""
