"""What each source of error contributes: `python -m experiments.uncertainty_sources`."""
