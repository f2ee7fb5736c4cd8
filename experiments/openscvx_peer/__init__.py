"""OpenSCvx on the same problem: `python -m experiments.openscvx_peer`."""
