"""Verify a solution independently, without the solver."""
