"""Timing and growth, run by hand: `python -m benchmarks`."""
