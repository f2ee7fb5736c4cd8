"""Chance-constrained flyby problems as convex subproblems: pure mathematics, arrays in, program out.

Everything here is nondimensional and knows no asteroid, no spacecraft and no file format.
"""
