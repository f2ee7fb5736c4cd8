"""Write exact P2 as a nonlinear program in the burns only: single shooting, exact first derivatives.

    min sum |v_i|   over the burns v
    s.t. the final state is met, the burns keep their limits, Phi^-1(P(v)) >= Phi^-1(p)

Everything is evaluated at the nonlinear flight of the burns. The P of a node is that of
`ray_quantiles`. The P of a whole flight is the planner's own estimate, from the same number of
directions, but in all columns of the factor. Vanishing burns make a kink in the cost, which is
smoothed to sqrt(|v|^2 + r^2) - r.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cache
from time import process_time
from typing import NamedTuple

import numpy as np
from scipy.special import ndtr, ndtri

from formulations.arrays import Array
from formulations.linearisation.linearisation import (
    Linearisation,
    LinearisationError,
    Sensitivity,
    condense,
    final_state_map,
    step_mean,
)
from formulations.problem.facets import quantile
from formulations.problem.flyby import FlybyProblem, Iterate, factor_columns_used
from formulations.risk.lines import sphere_directions
from formulations.rows.flight_probability import FlightProbability
from formulations.rows.node_probability import Event, Quantiles, joint_events
from scp_recon.mission.mission import Mission

RAYS = 2048
"""Directions, each both ways: P to some 1e-5."""

SURE = 3.5
"""Deviations beyond which a probability counts as one, and its gradient as none."""

UNSEEN = 1e-5
"""Probability below which too few rays see anything of it: there the least margin tells the way."""

SPREAD = 1e-6
"""Standard deviation added in each direction, in units of length; the planner's is the same."""

REACH = 5.0
"""Deviations within which a flight's limits are looked for: one farther off ends 3e-7 of flights."""

MISS, SHORT, BEYOND = 1e-6, 1e-5, 1e-7
"""Allowed of the final state, of a probability in deviations, and of the burns' limits."""

NEARLY, GAIN = 100.0, 1e-5
"""A point that misses no more than so many times that, and promises no such gain, gets nowhere."""
EVALUATIONS_MAX = 120
"""After which a search has come to its end."""

CLOSINGS, CLOSED = 8, 1e-12
"""Newton iterations that close the arcs of a flight before it is rolled out instead, and to what."""


class Stop(Exception):  # noqa: N818 -- no error: a search ends with its best point
    """The search makes no progress, or has used up its evaluations or processor time."""


ProbabilityRows = Callable[[Linearisation], tuple[Array, Array]]
"""Margins Phi^-1(P) - Phi^-1(p) at a flight, shape (r,), and derivatives in the burns, (r, nz)."""


class NodeRows:
    """Probability of every joint constraint at each of its nodes, by a number of rays."""

    def __init__(self, problem: FlybyProblem, probability: float, rays: int) -> None:
        self.events, self.asked = joint_events(problem.constraints), quantile(probability)
        self.rays = rays

    def __call__(self, lin: Linearisation) -> tuple[Array, Array]:
        """See `ProbabilityRows`."""
        mean, factor = lin.iterate.mean[:, :3], lin.factor[:, :3]
        node = np.concatenate([event.nodes for event in self.events])
        parts = [ray_quantiles(e, mean[e.nodes], factor[e.nodes], self.rays) for e in self.events]
        value, by_mean, by_factor = (np.concatenate(part) for part in zip(*parts, strict=True))
        told = np.flatnonzero(value < SURE)
        slope = np.zeros((len(value), lin.iterate.burns.size))
        nodes, at = np.unique(node[told], return_inverse=True)
        if len(told):
            s = condense(lin, nodes)
            slope[told] = _moved(s, at, by_mean[told], by_factor[told])
        return value - self.asked, slope


class FlightRow:
    """Probability of the whole flight, by a number of directions."""

    def __init__(self, problem: FlybyProblem, probability: float, lines: int) -> None:
        events, self.asked = joint_events(problem.constraints), quantile(probability)
        nodes = np.unique(np.concatenate([event.nodes for event in events]))
        directions = sphere_directions(lines, factor_columns_used(problem, nodes))
        self.estimate = FlightProbability(events, directions, REACH)

    def __call__(self, lin: Linearisation) -> tuple[Array, Array]:
        """See `ProbabilityRows`."""
        g = self.estimate(lin.iterate.mean[:, :3], lin.factor[:, :3])
        if len(g.nodes) == 0:
            return np.array([g.value - self.asked]), np.zeros((1, lin.iterate.burns.size))
        nodes, at = np.unique(g.nodes, return_inverse=True)
        slope = _moved(condense(lin, nodes), at, g.by_mean, g.by_factor)
        return np.array([g.value - self.asked]), slope.sum(axis=0, keepdims=True)


def _moved(s: Sensitivity, at: np.ndarray, by_mean: Array, by_factor: Array) -> Array:
    """Derivatives in the burns from those in mean and factor at some nodes, shape (r, nz)."""
    slope = np.einsum("ri,riz->rz", by_mean, s.mean_jacobian[at, :3])
    columns = by_factor.shape[2]
    slope += np.einsum(
        "rk,rkz->rz",
        by_factor.reshape(len(at), -1),
        s.factor_jacobian[at, :3, :columns].reshape(len(at), 3 * columns, -1),
    )
    return slope


class Point(NamedTuple):
    """Cost and constraints at some burns, with derivatives; equal = 0 and least >= 0.

    Attributes:
        burns: all components, shape (nz,).
        cost: rounded off.
        by_cost: shape (nz,).
        equal: the miss of the final state, shape (6,).
        by_equal: shape (6, nz).
        least: limits of the burns, then of the probability, shape (r,).
        by_least: shape (r, nz).
        allowed: whether all of it holds as it counts here.
    """

    burns: Array
    cost: float
    by_cost: Array
    equal: Array
    by_equal: Array
    least: Array
    by_least: Array
    allowed: bool


@dataclass
class BurnsProgram:
    """The nonlinear program; keeps the cheapest feasible point.

    The cost is rounded off by `rounding`, r. Each flight starts from the last one, `flown`. The search
    stops when `process_time` is past `until`, or after `patience` consecutive points without gain;
    `nowhere` counts them.
    """

    mission: Mission
    rows: ProbabilityRows
    rounding: float
    until: float
    flown: Linearisation
    patience: int
    evaluations: int = 0
    best: Point | None = None
    nowhere: int = 0
    _last: Point | None = None

    def at(self, burns: Array) -> Point:
        """Evaluate.

        Raises:
            Stop: if the search is to end.
            LinearisationError: if there is no finite flight of these burns.
        """
        if self._last is not None and np.array_equal(self._last.burns, burns):
            return self._last
        if process_time() > self.until:
            raise Stop("out of time")
        if self.nowhere >= self.patience:
            raise Stop(f"no gain of {GAIN:g}")
        if self.evaluations >= EVALUATIONS_MAX:
            raise Stop(f"{EVALUATIONS_MAX} evaluations")
        self.evaluations += 1
        burns = burns.copy()  # a solver may write its next point over this one
        lin = fly(self.mission, self.flown, burns.reshape(-1, 3))
        self.flown = lin
        value, slope = self.rows(lin)
        limits, by_limits = burn_limits(self.mission.problem, lin.iterate.burns)
        size = np.sqrt((lin.iterate.burns**2).sum(axis=1) + self.rounding**2)
        miss = lin.iterate.mean[-1] - self.mission.problem.final_state
        worst = max(np.abs(miss).max() / MISS, -value.min() / SHORT, -limits.min() / BEYOND)
        point = Point(
            burns,
            float(size.sum() - len(size) * self.rounding),
            (lin.iterate.burns / size[:, None]).ravel(),
            miss,
            final_state_map(lin)[1],
            np.concatenate([limits, value]),
            np.vstack([by_limits, slope]),
            bool(worst <= 1.0),
        )
        if self.best and worst <= NEARLY:
            gains = point.cost < self.best.cost * (1.0 - GAIN)
            self.nowhere = 0 if gains else self.nowhere + 1
        if point.allowed and (self.best is None or point.cost < self.best.cost):
            self.best = point
        self._last = point
        return point


def fly(mission: Mission, last: Linearisation, burns: Array) -> Linearisation:
    """The flight of some burns, its arcs closed by Newton's method from another flight.

    Raises:
        LinearisationError: if it has none that is finite.
    """
    with np.errstate(all="ignore"):
        lin = last
        for _ in range(CLOSINGS):
            lin = mission.dynamics.linearise(lin.problem, Iterate(burns, step_mean(lin, burns)))
            defect = np.abs(lin.defects[:-1]).max()
            if not defect < 1.0:
                break
            if defect <= CLOSED:
                return lin
        problem = mission.problem
        mean = mission.dynamics.rollout(problem.initial_state, burns)
        if not np.isfinite(mean).all():
            raise LinearisationError("no finite flight")
        return mission.dynamics.linearise(problem, Iterate(burns, mean))


def burn_limits(problem: FlybyProblem, burns: Array) -> tuple[Array, Array]:
    """Margins of size and battery cones, shape (3 m,), and their derivatives (3 m, 3 m)."""
    m = len(burns)
    planes = [cone.supporting(burns) for cone in problem.burn_cones]
    size = 0.5 * (problem.dv_max - (burns**2).sum(axis=1) / problem.dv_max)
    margins = np.concatenate([size, *(-plane.inside(burns) for plane in planes)])
    normals = [-burns / problem.dv_max, *(plane.normal for plane in planes)]
    jacobian = np.zeros((3 * m, m, 3))
    for kind, normal in enumerate(normals):
        jacobian[kind * m + np.arange(m), np.arange(m)] = normal
    return margins, jacobian.reshape(3 * m, 3 * m)


# --- the probability at a node by volumes along rays, and moments ------------------------------------


def ray_quantiles(event: Event, mean: Array, factor: Array, rays: int = RAYS) -> Quantiles:
    """Phi^-1(P), at most `SURE`, at each node of an event, and its gradient, independently.

    The planner integrates along a contour. Here the law is whitened, r = mu + L w, and rays go from its
    mean in all directions of space. On the set A that keeps the limits the moments of w have closed
    forms along each ray, and give the gradient (by the density's derivatives):

        P = E[1_A],  dP/dmu = L^-T E[w 1_A],  dP/dSigma = L^-T E[(w w' - I) 1_A] L^-1 / 2.

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
    """Intersection of two intervals; an empty one ends where it starts."""
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
