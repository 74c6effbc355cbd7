"""Tests of where cameras stand."""
