"""The convex program: written in CVXPY, compiled once, solved by a conic solver, proved optimal."""
