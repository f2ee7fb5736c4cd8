"""Compute entries of a scenario from others, subject by subject."""
