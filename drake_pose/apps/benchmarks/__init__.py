"""Benchmarks: ratios of time, memory, and workers (`make bench`)."""
