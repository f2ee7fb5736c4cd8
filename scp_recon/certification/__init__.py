"""Certify plans: the probability that they promise is reached by nonlinear flights."""
