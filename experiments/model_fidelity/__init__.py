"""Measure the effects that the planner's model leaves out: `python -m experiments model_fidelity`."""
