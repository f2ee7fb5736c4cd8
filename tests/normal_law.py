"""Probabilities of balls and cones under a normal law, by nested quadrature and by known laws.

Oracles for `formulations.rows.node_probability`: they know neither transforms nor contours, slice the
sets along fixed axes, and take hundreds of thousands of points for one number.
"""

import numpy as np
from scipy.special import ndtr
from scipy.stats import ncx2

from formulations.arrays import Array
from formulations.problem.regions import Ball, Cone, perpendicular

OUTER, INNER, TAIL = 800, 320, 9.0
"""Gauss-Legendre points over the slices and within each, over so many standard deviations either way:
slices of a slender law change within a small part of one."""

RULES = {count: np.polynomial.legendre.leggauss(count) for count in (OUTER, INNER)}


def points_between(low: Array, high: Array, count: int) -> tuple[Array, Array]:
    """Points and weights on intervals (...,), shape (..., count)."""
    at, weight = RULES[count]
    half = 0.5 * np.maximum(high - low, 0.0)[..., None]
    return low[..., None] + half * (1.0 + at), half * weight


def density(x: Array, mean: Array, sigma: Array) -> Array:
    return np.exp(-0.5 * ((x - mean) / sigma) ** 2) / (np.sqrt(2.0 * np.pi) * sigma)


def chord_angles(
    radius: Array, mean: Array, sigma: float, count: int = INNER
) -> tuple[Array, Array, Array]:
    """Points x = radius sin(a) where the law is, with weights dx, and the half chords across them."""
    with np.errstate(divide="ignore", invalid="ignore"):
        edges = [
            np.arcsin(np.clip((mean + sign * TAIL * sigma) / radius, -1.0, 1.0))
            for sign in (-1.0, 1.0)
        ]
    angle, weight = points_between(*edges, count)
    radius = radius[..., None]
    return radius * np.sin(angle), weight * radius * np.cos(angle), radius * np.cos(angle)


def disk(radius: Array, mean: Array, sigma: Array) -> Array:
    """Of disks (...,) about the origin; means (..., 2), and principal sigmas (2,), ascending."""
    x, dx, half = chord_angles(radius, mean[..., 0], sigma[0])
    y = mean[..., 1, None]
    inner = ndtr((half - y) / sigma[1]) - ndtr((-half - y) / sigma[1])
    return np.asarray((dx * density(x, mean[..., 0, None], sigma[0]) * inner).sum(axis=-1))


def ball_probability(ball: Ball, mean: Array, covariance: Array) -> float:
    """Slices across the axis of the least spread, and chords of the slices."""
    variance, axes = np.linalg.eigh(covariance)
    sigma, off = np.sqrt(variance), axes.T @ (mean - ball.center[0])
    x, dx, half = chord_angles(np.array(ball.radius), off[0], sigma[0], OUTER)
    slices = disk(half, np.broadcast_to(off[1:], (len(half), 2)), sigma[1:])
    return float((dx * density(x, off[0], sigma[0]) * slices).sum())


def cone_probability(cone: Cone, mean: Array, covariance: Array) -> float:
    """Slices across the cone's axis, where the law is the conditional one."""
    first = perpendicular(cone.axis)[0]
    frame = np.stack([first, np.cross(cone.axis[0], first), cone.axis[0]])
    off, spread = frame @ (mean - cone.apex[0]), frame @ covariance @ frame.T
    sigma = np.sqrt(spread[2, 2])
    pull = spread[:2, 2] / spread[2, 2]
    variance, axes = np.linalg.eigh(spread[:2, :2] - np.outer(pull, spread[2, :2]))
    low, high = np.maximum(off[2] + TAIL * sigma * np.array([-1.0, 1.0]), 0.0)
    height, weight = points_between(low, high, OUTER)
    centre = (off[:2] + (height[:, None] - off[2]) * pull) @ axes
    slices = disk(height * np.tan(cone.half_angle), centre, np.sqrt(variance))
    return float((weight * density(height, off[2], sigma) * slices).sum())


def round_ball_probability(radius: float, distance: Array, sigma: Array) -> Array:
    """Noncentral chi-square: the same spread in all directions."""
    shift = (distance / sigma) ** 2
    # SciPy's series errs by 3e-7 where this underflows.
    return np.asarray(ncx2.cdf((radius / sigma) ** 2, 3, np.where(shift < 1e-30, 0.0, shift)))
