"""Masks for a scene: from other tools, or found in pictures."""
