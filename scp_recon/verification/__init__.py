"""Verify a solution independently, without the solver.

`reintegration.verify` is the whole verdict; `consistency`, `probabilities` and `closed_loop` are its
parts. Certification and everything above it may import this folder; it never imports CVXPY.
"""
