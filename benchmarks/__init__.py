"""Time the planner and its commands, run by hand: `python -m benchmarks`.

`micro` times the parts of an iteration, `methods` one method in a process of its own. Nothing but its
tests may import this folder; it imports `scp_recon`, and the harness of `experiments`.
"""
