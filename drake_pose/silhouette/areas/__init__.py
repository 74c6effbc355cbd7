"""Exact areas of projected surfaces, without drawing them: the span kernel and what it needs."""
