"""Exact risk against nonlinear programming on the same problem, in 50 scenarios drawn at random."""
