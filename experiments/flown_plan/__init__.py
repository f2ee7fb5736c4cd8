"""A plan flown by the spacecraft, many times: `python -m experiments.flown_plan`."""
