"""Benchmarks: each module prints figures of tutorials/figures.md."""
