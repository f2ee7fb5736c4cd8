"""The row of P2 with exact risk of the whole flight: all limits hold at all nodes.

All positions of a flight are linear in few numbers: the state after the first burn and the
velocities after the others. The law of a flight is therefore expressed in these numbers, however
many sources of errors there are. Fewer dimensions need fewer directions.
"""

from __future__ import annotations

from copy import copy

import numpy as np
from scipy.linalg import null_space

from formulations.arrays import Array
from formulations.linearisation.linearisation import (
    Linearisation,
    Sensitivity,
    condense,
    gradient,
    miss_of,
)
from formulations.problem.flyby import FlybyProblem, factor_columns_used
from formulations.risk.lines import Directions, aimed_directions, sphere_directions
from formulations.rows.cones import Cones, Margins, curved_cones, on_states
from formulations.rows.corrected_burns import FurtherRows
from formulations.rows.exact import ExactRows, bent_by_gains
from formulations.rows.flight_probability import Coordinates, FlightProbability, FlightValue, Limits
from formulations.rows.node_probability import Quantiles

FLIGHT = "whole_flight"
"""Name of the one chance constraint of `FlightRows`."""

CURVATURE_LINES = 1024
"""Directions that a flight's curvature is estimated from."""

ENDS_MIN = 1e-9
"""Least share of flights that a limit ends, in density, for the limit to count in curvature."""

APART = 0.05
"""Change of a flight's g over which slopes are compared, in standard deviations."""

TANGENTS = 12
"""Tangents of a bundle, that of the iterate included."""

LANCZOS = 4
"""Directions of the gains in which slopes are compared."""

REMEMBERED = 3
"""Number of iterates whose probability is remembered: a stage begins at the end of the one before."""


class FlightRows(ExactRows):
    """All joint constraints hold at all nodes of the flight with the required probability: one row.

    The probability is estimated from a number of lines that is a power of two. Curvature begins as that
    of rows from fewer lines, if these are given.
    """

    condensed = False
    _tangents: list[tuple[Linearisation, float, Array]] | None = None
    _reach = 0.0

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
        self.further = FurtherRows(problem, 1)
        starts = problem.leg_starts[problem.leg_starts < nodes[-1]].tolist()
        self._coordinates = Coordinates(starts or [0], problem.parameters)
        felt = np.union1d(nodes, self._coordinates.nodes)
        self._columns = factor_columns_used(problem, felt)
        self.nodes = np.union1d(felt, self.further.nodes)
        self.count = 1 + self.further.count
        self._lines, self._begun = lines, rough
        self._look(sphere_directions(lines, self._coordinates.count))

    def _look(self, directions: Directions) -> None:
        """Use these directions for probabilities from now on."""
        few = Directions(*(part[:: max(1, self._lines // CURVATURE_LINES)] for part in directions))
        self.probability = FlightProbability(self.events, directions)
        self._rough = FlightProbability(self.events, few)
        self._seen: list[tuple[Array, Array, FlightValue]] = []
        self._bent: tuple[Array, Array, Array] | None = None

    def aim(self, lin: Linearisation) -> None:
        """Use directions of which half are drawn where an iterate's flights fail."""
        self._coordinates.settle(lin.spread.factor)
        mean, factor = lin.iterate.mean[:, :3], self._coordinates.reduced(lin.spread.factor)

        def failing(directions: Directions) -> Array:
            return FlightProbability(self.events, directions).failing(mean, factor)

        self._look(aimed_directions(self._lines, self._coordinates.count, failing))

    def bundled(self) -> FlightRows:
        """The same row, whose model is bounded also by its tangents where it was evaluated before.

        g has kinks where a flight's first broken limit changes. One slope says little about the other
        sides of near kinks, and steps towards them are refused however short they are. The minimum of
        tangents is a bundle: Lemarechal, Nemirovskii & Nesterov, "New variants of bundle methods",
        Math. Program. 69 (1995).
        """
        rows = copy(self)
        rows._seen, rows._tangents = [], []
        return rows

    def sloped(self, reach: float) -> FlightRows:
        """The same bundle, whose model is the least of the slopes known within `reach` of a control.

        All pass through the iterate, without curvature. What the model promises per radius is the norm
        of the smallest element in the hull of these gradients (dual to that of the trust region, with
        all other rows): Goldstein, "Optimization of Lipschitz continuous functions", Math. Program. 13
        (1977). Nearly nothing promised proves a minimum, which one gradient at a kink cannot.
        """
        rows = copy(self)
        rows._reach = reach
        return rows

    def margins(self, lin: Linearisation) -> dict[str, Margins]:
        """Margin of the whole flight, at the node where most flights break a limit."""
        g = self.at(lin)
        nodes = g.limits.nodes
        worst = nodes[np.argmax(g.ends)] if len(nodes) else self.nodes[0]
        own = {FLIGHT: Margins(np.array([worst]), np.array([g.value - self.required]))}
        return own | self.further.margins(lin)

    def cones(self, lin: Linearisation, s: Sensitivity) -> list[Cones]:
        """One row in all controls."""
        g, z = self.at(lin), lin.controls
        slope = gradient(lin, g.by_mean, g.by_factor)
        margin, slopes = np.array([g.value - self.required]), slope[None]
        bundled = bool(self._reach) or (
            self._tangents is not None and self.problem.feedback is None
        )
        if bundled:
            margin, slopes = self._bounds(lin, g, slope)
        rows = np.zeros(len(margin), np.intp)
        if self._reach:
            own = Cones(rows, slopes[:, None], (margin - slopes @ z)[:, None])
        else:
            bent = np.repeat(self._hessian(lin, g, slope)[None], len(margin), axis=0)
            own = curved_cones(rows, margin, slopes, bent, z, most=len(z))
        own = own._replace(shared=bundled)
        return [own, *self.further.cones(lin, s)]

    def _bounds(self, lin: Linearisation, g: FlightValue, slope: Array) -> tuple[Array, Array]:
        """Margins (TANGENTS,) and slopes (TANGENTS, controls) of tangents, the iterate's first.

        g is not quite concave: it falls as a root where a flight begins to touch a limit. A tangent
        that cuts off the iterate becomes a plane through both values, turned along the step between.
        """
        assert self._tangents is not None
        z, margins, slopes = lin.controls, [g.value], [slope]
        for other, value, own in self._tangents:
            step = other.controls - z
            length = float(step @ step)
            if self._reach:
                if 0.0 < np.abs(step).max() <= self._reach:
                    margins.append(g.value)
                    slopes.append(own)
            elif length > 0.0:
                above = value - float(own @ step) - g.value
                margins.append(g.value + max(above, 0.0))
                slopes.append(own + min(above, 0.0) / length * step)
        some = np.resize(np.arange(len(margins)), TANGENTS)
        return np.array(margins)[some] - self.required, np.array(slopes)[some]

    def state_cones(self, lin: Linearisation) -> list[Cones]:
        """The gradient acts on the mean and the factor of every node that may take part."""
        g, own = self.at(lin), self.cones(lin, condense(lin, self.nodes, factor=False))[0]
        own = Cones(own.rows[:1], own.values[:1], own.constants[:1], own.triangular)
        by_mean = np.pad(g.by_mean, ((0, 0), (0, 3)))
        by_factor = g.by_factor[:, :, : self._columns]
        by_states = np.concatenate([by_mean[:, :, None], by_factor], axis=2)
        row = np.zeros(len(self.nodes), dtype=np.intp)
        return [
            on_states(own, lin, row, self.nodes, by_states[self.nodes]),
            *self.further.state_cones(lin),
        ]

    def at(self, lin: Linearisation) -> FlightValue:
        """G at an iterate."""
        mean, factor = lin.iterate.mean[:, :3], lin.spread.factor
        for k, seen in enumerate(self._seen):
            if np.array_equal(seen[0], mean) and np.array_equal(seen[1], factor):
                self._seen.insert(0, self._seen.pop(k))
                return seen[2]
        found = self._coordinates(self.probability, mean, factor)
        if self._tangents is not None:
            own = lin, found.value, gradient(lin, found.by_mean, found.by_factor)
            self._tangents[:] = [own, *self._tangents[: TANGENTS - 2]]
        self._seen[:] = [(mean, factor, found), *self._seen[: REMEMBERED - 1]]
        return found

    def _hessian(self, lin: Linearisation, g: FlightValue, slope: Array) -> Array:
        """d2g/dz2 by all controls: by differences along some directions, else by `bent_by_gains`.

        The differences are kept until the controls have moved too far for them to be valid.
        """
        z, own = lin.controls, self._bent_by_gains(lin, g)
        free = _keeping_final_state(lin)
        step = APART / max(float(np.linalg.norm(slope @ free)), APART)
        if self._bent is None and self._begun is not None:
            self._bent = self._begun._bent
        if self._bent is None or np.linalg.norm((z - self._bent[0]) @ free) > step:
            met = g.limits.at(g.ends > ENDS_MIN)
            self._bent = z, *self._differences(lin, met, step, free, own)
        _, along, left = self._bent
        both = left @ along.T
        return np.asarray(own + both + both.T - along @ (along.T @ left) @ along.T)

    def _bent_by_gains(self, lin: Linearisation, g: FlightValue) -> Array:
        """What `bent_by_gains` says of all nodes together, shape (controls, controls)."""
        hessian = np.zeros((len(lin.controls), len(lin.controls)))
        if self.problem.feedback is not None:
            at, gains = np.unique(g.limits.nodes), self.problem.gain_controls
            quantiles = Quantiles(np.zeros(len(at)), g.by_mean[at], g.by_factor[at, :3])
            maps = condense(lin, at, factor=False).mean_jacobian[:, :3]
            bent = bent_by_gains(self.problem, quantiles, lin.factor[at, :3], maps)
            hessian[np.ix_(gains, gains)] = bent.sum(axis=0)
        return hessian

    def _differences(
        self, lin: Linearisation, met: Limits, step: float, free: Array, known: Array
    ) -> tuple[Array, Array]:
        """Orthonormal directions V, and T V less the known Hessian's part of it, (controls, .) each.

        T V by differences of slopes from few directions of flights, over steps long enough to
        average out the kinks where a flight's first broken limit changes. The directions are those
        of the burns and, for the gains, the ones in which the known Hessian errs most: the slope's
        direction, and then those of Lanczos' method. All keep the final state.
        """
        nodes = np.union1d(met.nodes, self._coordinates.nodes)
        s, burns = condense(lin, nodes), self.problem.moving_controls

        def slopes(moves: Array) -> Array:
            if len(moves) == 0:  # too few burns are left to change any
                return moves
            mean = np.repeat(lin.iterate.mean[None, :, :3], len(moves), axis=0)
            factor = np.repeat(lin.spread.factor[None], len(moves), axis=0)
            mean[:, nodes] += np.moveaxis(s.mean_jacobian[:, :3] @ moves.T, 2, 0)
            factor[:, nodes, :6] += np.moveaxis(s.factor_jacobian @ moves.T, 3, 0)
            found = self._coordinates.of_many(self._rough, mean, factor, met)
            by_mean = np.stack([g.by_mean[nodes].ravel() for g in found])
            by_factor = np.stack([g.by_factor[nodes].ravel() for g in found])
            by_controls = s.mean_jacobian[:, :3], s.factor_jacobian
            maps = [part.reshape(-1, len(lin.controls)) for part in by_controls]
            return np.asarray(by_mean @ maps[0] + by_factor @ maps[1])

        def differ(along: Array) -> Array:
            ahead, behind = np.split(slopes(step * np.vstack([along, -along])), 2)
            return np.asarray((ahead - behind) / (2.0 * step) - along @ known) @ free @ free.T

        along = free[:, free[burns].any(axis=0)].T
        left = differ(along)
        if self.problem.feedback is None:
            return along.T, left.T
        following = slopes(np.zeros((1, len(lin.controls))))[0]
        following[burns] = 0.0
        for _ in range(LANCZOS):
            following = following - along.T @ (along @ following)
            size = float(np.linalg.norm(following))
            if size < ENDS_MIN:
                break
            along = np.vstack([along, following / size])
            left = np.vstack([left, differ(along[-1:])])
            following = left[-1]
        return along.T, left.T


def _keeping_final_state(lin: Linearisation) -> Array:
    """Orthonormal directions of the controls that keep the final state, shape (controls, .)."""
    problem = lin.problem
    moving, gains = problem.moving_controls, problem.gain_controls
    kept = null_space(miss_of(lin)[1][:, moving])
    free = np.zeros((len(lin.controls), kept.shape[1] + len(gains)))
    free[moving, : kept.shape[1]] = kept
    free[gains, kept.shape[1] + np.arange(len(gains))] = 1.0
    return free
