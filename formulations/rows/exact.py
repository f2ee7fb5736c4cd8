"""Rows of P2 with exact risk, by the probability of the sets: per node or per flight.

On the normal quantile scale, g = Phi^-1(P), a chance constraint reads g >= Phi^-1(p), and its margin
g - Phi^-1(p) counts standard deviations. Each row has value, gradient and curvature of g at the
iterate, through means and factors affine in the burns z:

    g_k - q + g'd + c >= || (c, sqrt(c) H^(1/2) d) ||,    d = z - z_k,

which is g_k - q + g'd - d'Hd/2 >= 0 up to third order, with H the positive part of -g''. Far from
binding a row is left affine.
"""

from __future__ import annotations

import numpy as np
from scipy.linalg import null_space

from formulations.arrays import Array, Indices
from formulations.linearisation.linearisation import (
    Linearisation,
    Sensitivity,
    condense,
    final_state_map,
)
from formulations.problem.facets import quantile
from formulations.problem.flyby import FlybyProblem, factor_columns_used
from formulations.rows.cones import (
    POSITION,
    Cones,
    FinalSpread,
    Margins,
    Pulled,
    StateCones,
    Unit,
    burn_components_before,
    placed,
    pulled_at,
    triangular_cones,
)
from formulations.rows.flight_probability import (
    FlightProbability,
    FlightQuantile,
    Limits,
    sphere_directions,
)
from formulations.rows.node_probability import Quantiles, joint_events, node_quantiles

FLIGHT = "whole_flight"
"""Name of the one chance constraint of `FlightRows`."""

BINDING = 1.0
"""Margin, in standard deviations, up to which a row is curved."""

DIFFERENCE = 1e-5
"""Step of the differences that give a node's curvature, in units of speed."""

CURVATURE_LINES = 1024
"""Directions that a flight's curvature is estimated from."""

ENDS_MIN = 1e-9
"""Density of the flights that a limit ends at an iterate, from which on it takes part in curvature."""

APART = 0.05
"""Change of a flight's g over which slopes are compared, in standard deviations."""

REMEMBERED = 3
"""Iterates whose probability is remembered: a stage ends and the next begins where one was."""

BEND = 3.0
"""c: standard deviations over which a row bends before it goes on straight."""


def curved_cones(rows: Indices, margin: Array, slope: Array, hessian: Array, z: Array) -> Cones:
    """Rows margin + slope'd + d'hessian d/2 >= 0 in d about z, their concave part as a cone.

    Args:
        rows: index of each row's buffer, shape (r,).
        margin: at z, shape (r,).
        slope: shape (r, p).
        hessian: shape (r, p, p); only its negative part is used.
        z: burns about which the rows are made, shape (p,).
    """
    r, p = slope.shape
    curvature, axes = np.linalg.eigh(-0.5 * (hessian + hessian.swapaxes(1, 2)))
    bend = np.sqrt(BEND * np.maximum(curvature, 0.0))[:, :, None] * axes.swapaxes(1, 2)
    curved = np.any(bend, axis=(1, 2))
    tail = np.zeros((r, p + 1, p + 1))
    tail[:, :p, :p], tail[:, :p, p] = bend, -bend @ z
    tail[curved, p, p] = BEND
    head = np.column_stack([slope, margin - slope @ z + BEND * curved])
    return triangular_cones(rows, head, tail)


def on_states(
    cones: Cones, lin: Linearisation, row: Indices, nodes: Indices, gradient: Array
) -> StateCones:
    """Cones whose heads' slopes act on the states instead: only the curvature stays with the burns.

    Args:
        cones: as `curved_cones` makes them.
        lin: the iterate that they are made at.
        row: of the cones, which one a part of the gradient belongs to, shape (e,).
        nodes: where that part belongs, shape (e,).
        gradient: by positions and factors, side by side, shape (e, 3, 1 + c).
    """
    n, d, _ = cones.values.shape
    places = placed(
        (d * row)[:, None, None], nodes[:, None, None], POSITION, np.arange(gradient.shape[2])
    )
    at = np.concatenate([lin.iterate.mean[nodes, :3, None], lin.factor[nodes, :3]], axis=2)
    burns, constants = cones.values.copy(), cones.constants.copy()
    constants[:, 0] = cones.at(lin.iterate.burns)[:, 0]
    here = np.einsum("eij,eij->e", gradient, at[:, :, : gradient.shape[2]])
    constants[:, 0] -= np.bincount(row, here, n)
    burns[:, 0] = 0.0
    return StateCones(cones.rows, places, gradient.ravel(), burns, constants)


class ExactRows:
    """Base of both scopes: rows of exact risk with a required probability above one half."""

    with_factor = True
    near = BINDING
    unit: Unit = "sigma"

    def __init__(self, problem: FlybyProblem, probability: float, resolution: float) -> None:
        self.problem, self.resolution = problem, resolution
        self.events = joint_events(problem.constraints)
        self.required = quantile(probability)


class NodeRows(ExactRows):
    """Every joint constraint holds at every node with the required probability: one row each."""

    def __init__(self, problem: FlybyProblem, probability: float, resolution: float = 0.0) -> None:
        super().__init__(problem, probability, resolution)
        self.node = np.concatenate([event.nodes for event in self.events])
        self.final = FinalSpread(problem, len(self.node))
        self.nodes = np.union1d(self.node, self.final.nodes)
        self.count = len(self.node) + self.final.count
        self._first = np.cumsum([0, *(len(event.nodes) for event in self.events)])
        self._seen: tuple[Linearisation, Quantiles] | None = None

    def margins(self, lin: Linearisation) -> dict[str, Margins]:
        """Margins by joint constraint, at its nodes."""
        parts = np.split(self._at(lin).value - self.required, self._first[1:-1])
        return {
            event.name: Margins(event.nodes, part)
            for event, part in zip(self.events, parts, strict=True)
        } | self.final.margins(lin)

    def cones(self, lin: Linearisation, s: Sensitivity) -> list[Cones]:
        """Cones in a block for each number of burn components on which nodes depend."""
        g, z, blocks = self._at(lin), lin.iterate.burns.ravel(), []
        components = burn_components_before(self.problem, self.node)
        for p in np.unique(components):
            rows = np.flatnonzero(components == p)
            slope = self._slope(Quantiles(*(part[rows] for part in g)), rows, s, p)
            hessian = np.zeros((len(rows), p, p))
            near = np.flatnonzero(g.value[rows] - self.required < BINDING)
            if len(near):
                hessian[near] = self._hessian(rows[near], s, z, p)
            blocks.append(curved_cones(rows, g.value[rows] - self.required, slope, hessian, z[:p]))
        return blocks + self.final.cones(s)

    def state_cones(self, lin: Linearisation) -> list[StateCones]:
        """The gradient of each row acts on the mean and the factor of its node."""
        g = self._at(lin)
        used = factor_columns_used(self.problem, np.unique(self.node))
        gradient = np.concatenate([g.by_mean[:, :, None], g.by_factor[:, :, :used]], axis=2)
        own = self.cones(lin, condense(lin, self.nodes))[: -self.final.count or None]
        return [
            on_states(
                block, lin, np.arange(len(block.rows)), self.node[block.rows], gradient[block.rows]
            )
            for block in own
        ] + self.final.state_cones()

    def pulled(self, lin: Linearisation, prices: Array) -> Pulled:
        """Derivatives of -g at each row's node; see `Rows.pulled`."""
        g, own = self._at(lin), -prices[: len(self.node)]
        parts = own[:, None] * g.by_mean, own[:, None, None] * g.by_factor
        return self.final.pulled(pulled_at(self.problem, self.node, *parts), lin, prices)

    def _at(self, lin: Linearisation) -> Quantiles:
        """The quantiles g of all rows at an iterate."""
        if self._seen is None or self._seen[0] is not lin:
            mean, factor = lin.iterate.mean[self.node, :3], lin.factor[self.node, :3]
            self._seen = lin, self._quantiles(np.arange(len(self.node)), mean, factor)
        return self._seen[1]

    def _quantiles(self, rows: Indices, mean: Array, factor: Array) -> Quantiles:
        """The quantiles g of ascending rows, with a mean (r, 3) and factor (r, 3, c) for each."""
        cuts = np.searchsorted(rows, self._first)
        parts = []
        for event, first, start, stop in zip(
            self.events, self._first, cuts, cuts[1:], strict=False
        ):
            some, mine = event.at(rows[start:stop] - first), slice(start, stop)
            parts.append(node_quantiles(some, mean[mine], factor[mine]))
        return Quantiles(*(np.concatenate(part) for part in zip(*parts, strict=True)))

    def _slope(self, g: Quantiles, rows: Indices, s: Sensitivity, p: int) -> Array:
        """dg/dz of the rows of g, shape (r, p)."""
        at = np.searchsorted(self.nodes, self.node[rows])
        slope = np.einsum("ri,rip->rp", g.by_mean, s.mean_jacobian[at, :3, :p])
        slope += np.einsum("ric,ricp->rp", g.by_factor, s.factor_jacobian[at, :3, :, :p])
        return np.asarray(slope)

    def _hessian(self, rows: Indices, s: Sensitivity, z: Array, p: int) -> Array:
        """d2g/dz2 of some rows by differences of slopes, shape (r, p, p).

        All steps of all rows are taken at once, the first of each row being none.
        """
        at = np.searchsorted(self.nodes, self.node[rows])
        steps = z + DIFFERENCE * np.eye(p + 1, len(z), -1)
        mean = s.mean_constant[at, None, :3] + np.einsum(
            "riz,kz->rki", s.mean_jacobian[at, :3], steps
        )
        factor = s.factor_constant[at, None, :3] + np.einsum(
            "ricz,kz->rkic", s.factor_jacobian[at, :3], steps
        )
        every = np.repeat(rows, p + 1)
        shape = (len(every), 3, factor.shape[-1])
        g = self._quantiles(every, mean.reshape(-1, 3), factor.reshape(shape))
        slope = self._slope(g, every, s, p).reshape(-1, p + 1, p)
        return np.asarray(slope[:, 1:] - slope[:, :1]) / DIFFERENCE


class FlightRows(ExactRows):
    """All joint constraints hold at all nodes of the flight with the required probability: one row.

    The probability is estimated from a number of lines that is a power of two. Curvature begins as that
    of rows from fewer lines, if these are given.
    """

    def __init__(
        self,
        problem: FlybyProblem,
        probability: float,
        lines: int,
        resolution: float,
        rough: FlightRows | None = None,
    ) -> None:
        super().__init__(problem, probability, resolution)
        nodes = np.unique(np.concatenate([event.nodes for event in self.events]))
        self.final = FinalSpread(problem, 1)
        self.nodes = np.union1d(nodes, self.final.nodes)
        self.count = 1 + self.final.count
        dimension = factor_columns_used(problem, nodes)
        directions = sphere_directions(lines, dimension)
        self.probability = FlightProbability(self.events, directions)
        self._rough = FlightProbability(self.events, directions[:CURVATURE_LINES])
        self._seen: list[tuple[Array, Array, FlightQuantile]] = []
        self._bent: tuple[Array, Array] | None = None
        self._begun = rough

    def margins(self, lin: Linearisation) -> dict[str, Margins]:
        """Margin of the whole flight, at the node where most flights break a limit."""
        g = self._at(lin)
        worst = g.nodes[np.argmax(g.ends)] if len(g.nodes) else self.nodes[0]
        own = {FLIGHT: Margins(np.array([worst]), np.array([g.value - self.required]))}
        return own | self.final.margins(lin)

    def cones(self, lin: Linearisation, s: Sensitivity) -> list[Cones]:
        """One row in all burns."""
        g, z = self._at(lin), lin.iterate.burns.ravel()
        slope, free = self._slope(g, s), null_space(final_state_map(lin)[1])
        step = APART / max(float(np.linalg.norm(slope @ free)), APART)
        if self._bent is None and self._begun is not None:
            self._bent = self._begun._bent
        if self._bent is None or np.linalg.norm((z - self._bent[0]) @ free) > step:
            met = g.limits.at(g.ends > ENDS_MIN)
            self._bent = z, self._hessian(met, step, free, s, z)
        hessian = self._bent[1]
        margin = np.array([g.value - self.required])
        own = curved_cones(np.zeros(1, np.intp), margin, slope[None], hessian[None], z)
        return [own, *self.final.cones(s)]

    def _hessian(self, met: Limits, step: float, free: Array, s: Sensitivity, z: Array) -> Array:
        """d2g/dz2 along the directions `free` that keep the final state, shape (nz, nz).

        By differences of slopes from few directions, over steps long enough to average out the kinks
        where a flight's first broken limit changes. It is kept until the burns have moved that far.
        """
        bent = np.empty((free.shape[1], free.shape[1]))
        for j, direction in enumerate(step * free.T):
            ahead, behind = (
                self._rough_slope(met, s, z + move) for move in (direction, -direction)
            )
            bent[:, j] = (ahead - behind) @ free / (2.0 * step)
        return free @ bent @ free.T

    def state_cones(self, lin: Linearisation) -> list[StateCones]:
        """The gradient acts on the mean and the factor of every node that may take part."""
        g, own = self._at(lin), self.cones(lin, condense(lin, self.nodes))[0]
        parts = pulled_at(self.problem, g.nodes, g.by_mean, g.by_factor)
        gradient = np.concatenate([parts.by_mean[:, :, None], parts.by_factor], axis=2)
        row = np.zeros(len(self.nodes), dtype=np.intp)
        return [
            on_states(own, lin, row, self.nodes, gradient[self.nodes]),
            *self.final.state_cones(),
        ]

    def pulled(self, lin: Linearisation, prices: Array) -> Pulled:
        """Derivatives of -g at the nodes on which it depends; see `Rows.pulled`."""
        g = self._at(lin)
        parts = -prices[0] * g.by_mean, -prices[0] * g.by_factor
        return self.final.pulled(pulled_at(self.problem, g.nodes, *parts), lin, prices)

    def _at(self, lin: Linearisation) -> FlightQuantile:
        mean, factor = lin.iterate.mean[:, :3], lin.factor[:, :3]
        for seen in self._seen:
            if np.array_equal(seen[0], mean) and np.array_equal(seen[1], factor):
                return seen[2]
        found = self.probability(mean, factor)
        self._seen = [(mean, factor, found), *self._seen[: REMEMBERED - 1]]
        return found

    def _slope(self, g: FlightQuantile, s: Sensitivity) -> Array:
        """dg/dz, shape (nz,)."""
        at, d = np.searchsorted(self.nodes, g.nodes), g.by_factor.shape[2]
        slope = np.einsum("ri,riz->z", g.by_mean, s.mean_jacobian[at, :3])
        factor = s.factor_jacobian[at, :3, :d].reshape(-1, slope.size)
        return np.asarray(slope + g.by_factor.ravel() @ factor)

    def _rough_slope(self, met: Limits, s: Sensitivity, z: Array) -> Array:
        """dg/dz of the affine model at other burns, from few directions and limits."""
        every = np.zeros((self.problem.n_nodes, 3))
        every[self.nodes] = (s.mean_constant + s.mean_jacobian @ z)[:, :3]
        factor = np.zeros((len(every), 3, s.factor_constant.shape[2]))
        factor[self.nodes] = (s.factor_constant + s.factor_jacobian @ z)[:, :3]
        return self._slope(self._rough(every, factor, met), s)
