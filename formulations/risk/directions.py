"""Choose the directions of lines for probabilities: evenly, or half of them where flights fail.

Only few of many even directions meet the limits that flights are likely to break. The estimate has
a kink where the first broken limit changes on one of these lines. Half of the directions can
therefore be drawn from the angular central Gaussian law of a matrix A: the law of A^(1/2) z /
|A^(1/2) z| with z standard normal. Its density relative to the even law is

    |A|^(-1/2) (u'A^-1 u)^(-d/2)

(D. E. Tyler, "Statistical analysis for the angular central Gaussian distribution on the sphere",
Biometrika 74 (1987) 579, whose fixed point fits A to directions). All directions are weighted by
the density of the mixture (E. Veach and L. Guibas, "Optimally combining sampling techniques",
SIGGRAPH 1995). No weight exceeds two, and the estimate has no bias.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import lru_cache
from typing import NamedTuple

import numpy as np
from scipy.special import ndtri

from formulations.arrays import Array

SEED = 20200121
"""Seed of the scrambling: every run draws the same flights."""

ROUNDS, STEPS = 3, 4
"""Times that failing directions are looked for, and steps of Tyler's fixed point each time."""

EVEN = 0.1
"""Share of the even law's matrix in A, which bounds how narrow the aim is."""


class Directions(NamedTuple):
    """Unit vectors, shape (count, d), and their weights, of mean one, shape (count,)."""

    unit: Array
    weight: Array


def sphere_directions(count: int, dimension: int) -> Directions:
    """Quasi-random unit vectors, evenly: Sobol points through the normal quantile.

    The count is a power of two.
    """
    return Directions(_onto_sphere(normal_points(count, dimension)), np.ones(count))


def aimed_directions(
    count: int, dimension: int, failing: Callable[[Directions], Array]
) -> Directions:
    """Directions of which half are drawn where flights fail.

    Args:
        count: a power of two.
        dimension: d.
        failing: probability that a flight fails on each of some lines, shape (count,).
    """
    normal, eye = normal_points(count, dimension), np.eye(dimension)
    even, half = _onto_sphere(normal[: count // 2]), count // 2
    matrix, found = eye, Directions(_onto_sphere(normal), np.ones(count))
    for _ in range(ROUNDS):
        share = found.weight * failing(found)
        if share.sum() <= 0.0:
            break
        matrix = _fitted(found.unit, share / share.sum())
        root = np.linalg.cholesky(matrix)
        unit = np.vstack([even, _onto_sphere(normal[half:] @ root.T)])
        density = np.linalg.norm(np.linalg.solve(root, unit.T), axis=0) ** -dimension
        density /= np.prod(np.diag(root))
        found = Directions(unit, 2.0 / (1.0 + density))
    return found


def _fitted(unit: Array, share: Array) -> Array:
    """A of determinant one by Tyler's fixed point, for directions with shares that sum up to one."""
    dimension = unit.shape[1]
    eye = np.eye(dimension)
    matrix = eye
    for _ in range(STEPS):
        square = np.einsum("ni,ni->n", unit, np.linalg.solve(matrix, unit.T).T)
        fitted = np.einsum("n,ni,nj->ij", dimension * share / square, unit, unit)
        matrix = (1.0 - EVEN) * fitted * dimension / np.trace(fitted) + EVEN * eye
    return np.asarray(matrix / np.linalg.det(matrix) ** (1.0 / dimension))


@lru_cache(maxsize=8)
def normal_points(count: int, dimension: int) -> Array:
    """Quasi-random standard normal vectors, shape (count, dimension), always the same.

    The count is a power of two.
    """
    from scipy.stats import qmc  # half a second to import

    points = np.asarray(ndtri(qmc.Sobol(dimension, scramble=True, rng=SEED).random(count)))
    points.flags.writeable = False
    return points


def _onto_sphere(vectors: Array) -> Array:
    return np.asarray(vectors / np.linalg.norm(vectors, axis=1, keepdims=True))
