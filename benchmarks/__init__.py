"""Time the planner and its commands, run by hand: `python -m benchmarks`."""
