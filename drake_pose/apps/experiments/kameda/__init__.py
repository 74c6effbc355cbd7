"""Kameda's experiment A."""
