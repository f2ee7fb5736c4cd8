"""The part that each source of error has in the spread: `python -m experiments uncertainty_sources`."""
