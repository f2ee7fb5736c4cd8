"""Measure each source of error's part in the spread: `python -m experiments uncertainty_sources`."""
