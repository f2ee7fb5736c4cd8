"""Compare exact risk with nonlinear programming on the same problem, in 50 random scenarios."""
