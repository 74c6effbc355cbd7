"""Tests of the registration of cameras."""
