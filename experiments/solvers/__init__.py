"""Studies of forms, algorithms and solvers."""
