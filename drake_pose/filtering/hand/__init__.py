"""Shimada's two-finger hand: its projection, and its observation."""
