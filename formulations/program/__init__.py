"""The convex program, once, in CVXPY: written, compiled, handed to a conic solver, and proved."""
