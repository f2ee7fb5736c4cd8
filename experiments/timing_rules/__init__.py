"""How long the attitude modes have to be: `python -m experiments.timing_rules`."""
