"""The probability at a node by means other than the planner's: volumes along rays, and moments.

The planner integrates along the normal of the nearest facet, and has its gradient from where lines meet
the limits. Here the law is whitened, r = mu + L w, and rays go from its mean in all directions of
space, so that no facet is singled out. Of the part A that keeps the limits the moments of w have
closed forms along each ray, and are the gradient (the density's own derivatives):

    P = E[1_A],  dP/dmu = L^-T E[w 1_A],  dP/dSigma = L^-T E[(w w' - I) 1_A] L^-1 / 2.
"""

from __future__ import annotations

from functools import cache
from typing import NamedTuple

import numpy as np
from scipy.special import ndtr, ndtri

from formulations.problem.regions import Array
from formulations.rows.node_probability import Event, Quantiles

RAYS = 2048
"""Directions, each both ways: P to some 1e-5."""

SURE = 3.5
"""Deviations beyond which a probability counts as one, and its gradient as none."""

UNSEEN = 1e-5
"""Probability below which too few rays see anything of it: there the least margin tells the way."""

SPREAD = 1e-6
"""Standard deviation added in each direction, in units of length; the planner's is the same."""


def ray_quantiles(event: Event, mean: Array, factor: Array, rays: int = RAYS) -> Quantiles:
    """Phi^-1(P), at most `SURE`, at each node of an event, and its gradient.

    Args:
        event: with at most one region to keep in and one to keep out of.
        mean: positions at its nodes, shape (n, 3).
        factor: of them, shape (n, 3, c).
        rays: directions.
    """
    covariance = factor @ factor.swapaxes(1, 2) + SPREAD**2 * np.eye(3)
    value, by_mean, by_covariance = _nearest(event, mean, covariance)
    near = np.flatnonzero(value < SURE + 0.7)
    if len(near):
        p, p_mean, p_covariance = _moments(event.at(near), mean[near], covariance[near], rays)
        g = np.minimum(ndtri(np.clip(p, UNSEEN, 1.0 - 1e-12)), SURE)
        told = p > UNSEEN
        per_g = np.sqrt(2.0 * np.pi) * np.exp(0.5 * g * g) * (g < SURE)
        at = near[told]
        value[at] = g[told]
        by_mean[at] = (per_g[:, None] * p_mean)[told]
        by_covariance[at] = (per_g[:, None, None] * p_covariance)[told]
    sure = value >= SURE
    value[sure], by_mean[sure], by_covariance[sure] = SURE, 0.0, 0.0
    return Quantiles(value, by_mean, 2.0 * by_covariance @ factor)


def _nearest(event: Event, mean: Array, covariance: Array) -> tuple[Array, Array, Array]:
    """Distance to the nearest limit in standard deviations along its normal, with gradients."""
    normals, offsets = event.facets(mean)
    room = offsets - np.einsum("lni,ni->ln", normals, mean)
    sigma = np.sqrt(np.einsum("lni,nij,lnj->ln", normals, covariance, normals))
    least, nodes = np.argmin(room / sigma, axis=0), np.arange(len(mean))
    normal, sigma, room = normals[least, nodes], sigma[least, nodes], room[least, nodes]
    outer = normal[:, :, None] * normal[:, None]
    by_covariance = -(0.5 * room / sigma**3)[:, None, None] * outer
    return room / sigma, -normal / sigma[:, None], by_covariance


def _moments(event: Event, mean: Array, covariance: Array, rays: int) -> tuple[Array, Array, Array]:
    """Probability P at each node, dP/dmean and dP/dcovariance."""
    root = np.asarray(np.linalg.cholesky(covariance), dtype=float)
    u = fibonacci_directions(rays)
    along = u @ root.swapaxes(1, 2)
    start = np.broadcast_to(mean[:, None], along.shape)
    everything = np.full(along.shape[:2], np.inf)
    low, high = -everything, everything
    for region in event.keep_in:
        low, high = _common((low, high), region.chord(start, along))
    kept = _zeroth_to_second(low, high)
    for region in event.keep_out:
        kept = kept.less(_zeroth_to_second(*_common((low, high), region.chord(start, along))))
    p = kept.zeroth.mean(axis=1)
    first = kept.first @ u / len(u)
    # Of what is lost, that is: of all w the rays have w w' - I no better than to a thousandth.
    lost = (3.0 - kept.second) @ (u[:, :, None] * u[:, None]).reshape(len(u), 9) / len(u)
    second = (1.0 - p)[:, None, None] * np.eye(3) - lost.reshape(-1, 3, 3)
    inverse = np.linalg.inv(root)
    by_mean = np.einsum("nji,nj->ni", inverse, first)
    return p, by_mean, 0.5 * inverse.swapaxes(1, 2) @ second @ inverse


def _common(one: tuple[Array, Array], other: tuple[Array, Array]) -> tuple[Array, Array]:
    """Where both intervals are; an empty one ends where it starts."""
    low = np.maximum(one[0], other[0])
    return low, np.maximum(np.minimum(one[1], other[1]), low)


class _RayMoments(NamedTuple):
    """Integrals of 1, s and s^2 over a part of each ray, shape (n, rays) each."""

    zeroth: Array
    first: Array
    second: Array

    def less(self, other: _RayMoments) -> _RayMoments:
        return _RayMoments(*(a - b for a, b in zip(self, other, strict=True)))


def _zeroth_to_second(low: Array, high: Array) -> _RayMoments:
    """With the density s^2 phi(s) of a normal vector of three along a line through its mean."""
    ends = []
    for s in (low, high):
        t = np.clip(s, -40.0, 40.0)
        density = np.exp(-0.5 * t * t) / np.sqrt(2.0 * np.pi)
        phi = ndtr(t)
        ends.append(
            (
                phi - t * density,
                -(t * t + 2.0) * density,
                3.0 * phi - (t**3 + 3.0 * t) * density,
            )
        )
    return _RayMoments(*(b - a for a, b in zip(*ends, strict=True)))


@cache
def fibonacci_directions(count: int) -> Array:
    """Unit vectors spread evenly over a hemisphere by the golden angle, shape (count, 3)."""
    k = np.arange(count) + 0.5
    height = k / count
    angle = np.pi * (1.0 + np.sqrt(5.0)) * k
    across = np.sqrt(1.0 - height**2)
    return np.stack([across * np.cos(angle), across * np.sin(angle), height], axis=1)
