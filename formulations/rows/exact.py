"""Rows of P2 with exact risk: one row for each joint constraint at each node.

On the normal quantile scale, g = Phi^-1(P), a chance constraint reads g >= Phi^-1(p), and its margin
g - Phi^-1(p) counts standard deviations. Each row has value, gradient and curvature of g at the
iterate, through means and factors affine in the burns z:

    g_k - q + g'd + c >= || (c, sqrt(c) H^(1/2) d) ||,    d = z - z_k,

which is g_k - q + g'd - d'Hd/2 >= 0 up to third order, with H the positive part of -g''. Far from
binding a row is left affine.
"""

from __future__ import annotations

import numpy as np

from formulations.arrays import Array, Indices
from formulations.linearisation.linearisation import Linearisation, Seen, Sensitivity, condense
from formulations.problem.facets import quantile
from formulations.problem.flyby import FlybyProblem, factor_columns_used
from formulations.rows.cones import (
    BINDING,
    Cones,
    Margins,
    Unit,
    controls_felt,
    curved_cones,
    on_states,
)
from formulations.rows.corrected_burns import FurtherRows
from formulations.rows.node_probability import Quantiles, joint_events, moving_quantiles

DIFFERENCE = 1e-5
"""Step of the differences that give a node's curvature, in units of speed."""


def bent_by_gains(problem: FlybyProblem, g: Quantiles, factor: Array, map_: Array) -> Array:
    """Curvature of g in the gains by each node's covariance, shape (r, gains, gains).

    g depends on a factor S by S S' only, so that dg/dS = 2 H S, and to second order H has the share
    tr(dS'H dS) in g; only what is negative of H is used. Gains U_i change a factor by B_i dU_i Xi with
    Xi Xi' = I, so that each column of dU feels the same H.

    Args:
        problem: with feedback.
        g: at r nodes.
        factor: of the positions there, shape (r, 3, d).
        map_: of the controls to the positions there, shape (r, 3, controls).
    """
    feedback = problem.feedback
    assert feedback is not None
    inverse = np.linalg.pinv(factor @ factor.swapaxes(1, 2), hermitian=True)
    half = 0.5 * g.by_factor @ factor.swapaxes(1, 2) @ inverse
    values, axes = np.linalg.eigh(0.5 * (half + half.swapaxes(1, 2)))
    negative = (axes * np.minimum(values, 0.0)[:, None]) @ axes.swapaxes(1, 2)
    by_burn = [map_[:, :, problem.burn_controls[i]] for i in feedback.burns]
    bent = np.zeros((len(map_), feedback.size, feedback.size))
    first = feedback.first_gain
    for j, one in enumerate(by_burn):
        for k, other in enumerate(by_burn):
            block = 2.0 * one.swapaxes(1, 2) @ negative @ other
            own = np.zeros((len(map_), 3, 6 * (j + 1), 3, 6 * (k + 1)))
            both = np.arange(6 * (min(j, k) + 1))
            own[:, :, both, :, both] = block
            shape = len(map_), 18 * (j + 1), 18 * (k + 1)
            bent[:, first[j] : first[j + 1], first[k] : first[k + 1]] = own.reshape(shape)
    return bent


class ExactRows:
    """Base of both scopes: rows of exact risk with a required probability above one half."""

    with_factor = condensed = True
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
        self.further = FurtherRows(problem, len(self.node))
        self.nodes = np.union1d(self.node, self.further.nodes)
        self.count = len(self.node) + self.further.count
        self._first = np.cumsum([0, *(len(event.nodes) for event in self.events)])
        self._seen = Seen[Quantiles]()

    def margins(self, lin: Linearisation) -> dict[str, Margins]:
        """Margins by joint constraint, at its nodes."""
        parts = np.split(self._at(lin).value - self.required, self._first[1:-1])
        return {
            event.name: Margins(event.nodes, part)
            for event, part in zip(self.events, parts, strict=True)
        } | self.further.margins(lin)

    def cones(self, lin: Linearisation, s: Sensitivity) -> list[Cones]:
        """Cones in a block for each number of burn components on which nodes depend."""
        g, z, blocks = self._at(lin), lin.controls, []
        felt = controls_felt(self.problem, self.node)
        for p in np.unique(felt):
            rows = np.flatnonzero(felt == p)
            slope = self._slope(Quantiles(*(part[rows] for part in g)), rows, s, p)
            hessian = np.zeros((len(rows), p, p))
            near = np.flatnonzero(g.value[rows] - self.required < BINDING)
            if len(near):
                hessian[near] = self._hessian(rows[near], s, lin, p)
            blocks.append(curved_cones(rows, g.value[rows] - self.required, slope, hessian, z[:p]))
        return blocks + self.further.cones(lin, s)

    def state_cones(self, lin: Linearisation) -> list[Cones]:
        """The gradient of each row acts on the mean and the factor of its node."""
        g = self._at(lin)
        used = factor_columns_used(self.problem, np.unique(self.node))
        gradient = np.concatenate([g.by_mean[:, :, None], g.by_factor[:, :, :used]], axis=2)
        own = self.cones(lin, condense(lin, self.nodes))[: -self.further.count or None]
        return [
            on_states(
                block, lin, np.arange(len(block.rows)), self.node[block.rows], gradient[block.rows]
            )
            for block in own
        ] + self.further.state_cones(lin)

    def _at(self, lin: Linearisation) -> Quantiles:
        """The quantiles g of all rows at an iterate."""
        if lin in self._seen:
            return self._seen[lin]
        mean, factor = lin.iterate.mean[self.node, :3], lin.factor[self.node, :3]
        found = self._quantiles(np.arange(len(self.node)), mean, factor)
        self._seen[lin] = found
        return found

    def _quantiles(self, rows: Indices, mean: Array, factor: Array) -> Quantiles:
        """The quantiles g of ascending rows, with a mean (r, 3) and factor (r, 3, c) for each."""
        cuts, parameters = np.searchsorted(rows, self._first), self.problem.parameter_factor
        parts = []
        for event, first, start, stop in zip(
            self.events, self._first, cuts, cuts[1:], strict=False
        ):
            some, mine = event.at(rows[start:stop] - first), slice(start, stop)
            parts.append(moving_quantiles(some, mean[mine], factor[mine], parameters))
        return Quantiles(*(np.concatenate(part) for part in zip(*parts, strict=True)))

    def _slope(self, g: Quantiles, rows: Indices, s: Sensitivity, p: int) -> Array:
        """dg/dz of the rows of g, shape (r, p)."""
        at = np.searchsorted(self.nodes, self.node[rows])
        slope = np.einsum("ri,rip->rp", g.by_mean, s.mean_jacobian[at, :3, :p])
        slope += np.einsum("ric,ricp->rp", g.by_factor, s.factor_jacobian[at, :3, :, :p])
        return np.asarray(slope)

    def _hessian(self, rows: Indices, s: Sensitivity, lin: Linearisation, p: int) -> Array:
        """d2g/dz2 of some rows, shape (r, p, p): by differences in burns, and `bent_by_gains`.

        All steps of all rows are taken at once, the first of each row being none.
        """
        problem, z = self.problem, lin.controls
        at = np.searchsorted(self.nodes, self.node[rows])
        burns = problem.moving_controls
        burns = burns[burns < p]
        steps = z + DIFFERENCE * np.vstack([np.zeros(len(z)), np.eye(len(z))[burns]])
        mean = s.mean_constant[at, None, :3] + np.einsum(
            "riz,kz->rki", s.mean_jacobian[at, :3], steps
        )
        factor = s.factor_constant[at, None, :3] + np.einsum(
            "ricz,kz->rkic", s.factor_jacobian[at, :3], steps
        )
        every = np.repeat(rows, len(steps))
        shape = (len(every), 3, factor.shape[-1])
        g = self._quantiles(every, mean.reshape(-1, 3), factor.reshape(shape))
        slope = self._slope(g, every, s, p).reshape(-1, len(steps), p)
        hessian = np.zeros((len(rows), p, p))
        hessian[:, burns] = np.asarray(slope[:, 1:] - slope[:, :1]) / DIFFERENCE
        if problem.feedback is None:
            return hessian
        hessian[:, :, burns] = hessian[:, burns].swapaxes(1, 2)
        here = Quantiles(*(part[rows] for part in self._at(lin)))
        factor = lin.factor[self.node[rows], :3]
        bent = bent_by_gains(problem, here, factor, s.mean_jacobian[at, :3])
        gains = problem.gain_controls[problem.gain_controls < p]
        hessian[:, gains[:, None], gains] = bent[:, : len(gains), : len(gains)]
        return hessian
