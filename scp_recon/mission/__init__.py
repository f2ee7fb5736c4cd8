"""A scenario resolved: window, schedule, grid, and the nondimensional problem."""
