"""Probabilities of balls, cones and their intersections under normal laws, with gradients."""
