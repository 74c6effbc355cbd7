"""Masks of an object in pictures: given by other tools, or found."""
