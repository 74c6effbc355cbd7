"""Kameda's search: node by node, with backtracking (sections 5.1 and 5.2)."""
