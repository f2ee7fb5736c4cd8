"""Independent checks of a solution, without the solver."""
