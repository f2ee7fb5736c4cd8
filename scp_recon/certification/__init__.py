"""Certify plans: nonlinear flights must reach the required probability."""
