"""Compute the paper's table of observation times: `python -m experiments observation_table`."""
