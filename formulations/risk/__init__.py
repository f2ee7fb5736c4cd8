"""Probabilities of balls, cones and their intersections under normal laws, with gradients.

`lines` integrates along lines, `quadratic_forms` along a contour, `strata` estimates rare failures by
flights. Everything above may import this folder; it imports `arrays` alone.
"""
