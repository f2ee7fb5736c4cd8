"""The effects that the planner's model leaves out, measured: `python -m experiments model_fidelity`."""
