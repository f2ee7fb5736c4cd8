"""Resolve a scenario into the planner's input: window, schedule, grid, problem; check its entries.

The border of SI: `mission.Mission` makes quantities nondimensional for `formulations`.
Planning and everything above it may import this folder; it imports `physics` and `scenario`.
"""
