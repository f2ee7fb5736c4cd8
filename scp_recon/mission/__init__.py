"""Resolve a scenario into window, schedule, grid and the nondimensional problem."""
