"""Rows of P2 for drifts: free flights after a burn that is missed or cut short, one row each.

A drift depends on mean and factor of the state at which it begins, (x, S). Its own mean m_j is flown
from there, and its factor is P_j S with the STMs P_j along that mean. The row holds the probability
that the whole drift keeps out of all regions at all nodes:

    g(x, S) = Phi^-1(P(no flight m_j + P_j S w inside a region at any node j)) >= required.

The law has the six dimensions of the state. With G_j the derivative of g by the factor at node j, and
T_j the second-order tensor of arc j, the chain rule along the drift gives

    dg/dS = R_0,  R_j = sum over l >= j of P_l' G_l,
    dg/dx = sum over j of P_j' (dg/dm_j + T_j : (P_{j+1}^-T R_{j+1} (P_j S)')).
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from formulations.arrays import Array, Indices
from formulations.linearisation.dynamics import Dynamics
from formulations.linearisation.linearisation import (
    Linearisation,
    Seen,
    affine_maps,
    gradient,
    require_finite,
)
from formulations.problem.flow import ArcDerivatives, bending, by_parameters
from formulations.problem.flyby import Drift, FlybyProblem, Legs
from formulations.problem.regions import Ball
from formulations.risk.lines import sphere_directions
from formulations.rows.cones import Cones, Margins, on_states
from formulations.rows.flight_probability import Coordinates, FlightProbability
from formulations.rows.node_probability import SPREAD_MIN, Event

LINES, REACH = 256, 5.0
"""Directions, each taken both ways, by which the probability of a drift is computed, and deviations
within which its regions are evaluated."""

HOPELESS, FAR = -4.0, 1.0
"""g below which almost no flight keeps out, and room above what is required beyond which a row cannot
bind: there the tangent planes give value and derivative."""

LITTLE = 0.25
"""Standard deviations, less than that room, by which a start may be apart from the last for its
derivatives to serve: by no more than that comes any plane along the drift nearer."""

NEWTON_MAX, CLOSED = 12, 1e-9
"""Iterations of Newton's method for a drift's mean, and the last step, whose square is rounding."""

DEEP = 0.5
"""Depth in a ball, over its radius, beyond which the further course of a mean says nothing."""

NO_BURNS = np.zeros((0, 3))


class Start(NamedTuple):
    """Mean (6,) and factor (6 + p, c) at a drift's start; or derivatives of a number by them.

    The factor's p rows of uncertain parameters are constant: no derivative is by them.
    """

    mean: Array
    factor: Array


class DriftValue(NamedTuple):
    """g of a drift, its derivatives by the drift's start, and its means (n, 6) if known in full."""

    value: float
    by: Start
    path: Array | None


class Branch:
    """Evaluates a drift with p uncertain parameters, and keeps what it has found for a start nearby.

    Newton's method for its means starts from a `path`, if one is given, and then from the last.
    """

    def __init__(self, drift: Drift, parameters: int = 0, path: Array | None = None) -> None:
        n = drift.flow.arcs + 1
        self._drift, self._legs = drift, Legs(n, np.array([0, n - 1]))
        self._free = Dynamics(drift.flow, np.zeros(0, dtype=np.intp))
        self._event = Event(drift.name, np.arange(n), (), drift.keep_out)
        self._coordinates, self._parameters = Coordinates([0], parameters), parameters
        self._directions = sphere_directions(LINES, self._coordinates.count)
        self._last: tuple[Start, DriftValue] | None = None
        self._path = path if path is not None and len(path) == n else None

    def __call__(self, start: Start) -> DriftValue:
        """Value and derivatives, see `DriftValue`; from the last ones where the row cannot bind.

        Raises:
            LinearisationError: if the drift has no finite derivatives.
        """
        if self._last is not None:
            (mean, factor), (value, by, path) = self._last
            is_far = value > self._drift.required + FAR
            if is_far and _apart(self._last[0], start) < LITTLE:
                change = by.mean @ (start.mean - mean)
                change += np.sum(by.factor * (start.factor - factor)[:6])
                return DriftValue(value + float(change), by, path)
        found = self.anew(start)
        self._last = start, found
        return found

    def anew(self, start: Start) -> DriftValue:
        """Value and derivatives, evaluated there."""
        mean, stm = self.flown(start.mean)
        value, by_mean, by_factor = self._at_nodes(mean, stm @ start.factor)
        n = 1 + max(map(_last, (by_mean, by_factor)))
        arcs = self._drift.flow.differentiate(mean[: n - 1])
        by = _pulled(stm[:n], arcs, start.factor, by_mean[:n], by_factor[:n])
        require_finite(*by)
        return DriftValue(value, by, self._path)

    def by_planes(self, start: Start) -> float:
        """Least room over deviation at tangent planes: less than the law's value, if that knows all."""
        mean, stm = self.flown(start.mean)
        return tangent(self._event.at(np.arange(len(mean))), mean, stm @ start.factor)[0]

    def _at_nodes(self, mean: Array, factor: Array) -> tuple[float, Array, Array]:
        """As `tangent`, from means and factors at the nodes; by the law near to binding."""
        event = self._event.at(np.arange(len(mean)))
        nearest = tangent(event, mean, factor)
        if self._drift.by_planes or nearest[0] > self._drift.required + FAR:
            return nearest
        probability = FlightProbability((event,), self._directions, REACH)
        found = self._coordinates(probability, mean[:, :3], factor)
        if len(found.limits.nodes) == 0 or found.value < HOPELESS:
            return nearest
        return found.value, found.by_mean, found.by_factor

    def flown(self, state: Array) -> tuple[Array, Array]:
        """Means (n, 6) from a state (6,), and STMs of state and parameters from there.

        The STMs have shape (n, 6 + p, 6 + p).

        Nodes after the mean is deep inside a ball are left out.
        """
        flow = self._drift.flow
        # What comes after a passage through the centre may be any number, and is left out.
        with np.errstate(all="ignore"):
            mean = self._free.rollout(state, NO_BURNS) if self._path is None else self._path
            for _ in range(NEWTON_MAX):
                arcs = flow.differentiate(mean[:-1])
                stm = self._composed(arcs, arcs.state - mean[1:])
                step = stm[:, :6, :7] @ np.r_[state - mean[0], 1.0]
                mean = mean + step
                n = self._meaningful(mean)
                if np.abs(step[:n]).max() < CLOSED:
                    break
            else:
                mean = self._free.rollout(state, NO_BURNS)
                n = self._meaningful(mean)
                arcs = flow.differentiate(mean[:-1])
                stm = self._composed(arcs, np.zeros_like(mean[1:]))
        self._path = mean if n == len(mean) else None
        if not self._parameters:
            return mean[:n], stm[:n, :6, :6]
        return mean[:n], np.delete(np.delete(stm[:n], 6, axis=1), 6, axis=2)

    def _composed(self, arcs: ArcDerivatives, defects: Array) -> Array:
        """Maps of `affine_maps` from the drift's start to its nodes, shape (n, 7 + p, 7 + p)."""
        maps = affine_maps(arcs.stm, defects, by_parameters(arcs, self._parameters))
        return self._legs.compose(maps)

    def _meaningful(self, mean: Array) -> int:
        """Number of first nodes up to where a mean (n, 6) is deep inside a ball."""
        deep = np.zeros(len(mean), dtype=np.bool_)
        for ball in self._drift.keep_out:
            depth = ball.inside(mean[:, :3])
            deep |= ~(depth < DEEP * ball.radius)
        return int(np.argmax(deep)) + 1 if deep.any() else len(mean)


def _apart(one: Start, other: Start) -> float:
    """Distance of two starts in standard deviations of the first; inf if its covariance is singular."""
    spread = one.factor[:6] @ one.factor[:6].T
    try:
        root = np.linalg.cholesky(spread)
    except np.linalg.LinAlgError:
        return np.inf
    by = np.c_[other.mean - one.mean, (other.factor - one.factor)[:6]]
    moved = np.linalg.solve(root, by)
    return float(np.linalg.norm(moved[:, 0]) + np.linalg.norm(moved[:, 1:]))


def tangent(event: Event, mean: Array, factor: Array) -> tuple[float, Array, Array]:
    """Least room over deviation at the planes that touch each region nearest to the mean.

    Returns:
        The value, and its derivatives by means (n, 3) and the state's factors (n, 6, c).
    """
    by_mean, by_factor = np.zeros((len(mean), 3)), np.zeros((len(mean), 6, factor.shape[2]))
    normals, offsets = event.facets(mean[:, :3])
    room = offsets - np.einsum("lni,ni->ln", normals, mean[:, :3])
    along = np.einsum("lni,nic->lnc", normals, factor[:, :3])
    deviation = np.maximum(np.linalg.norm(along, axis=-1), SPREAD_MIN)
    limit, node = np.unravel_index(np.argmin(room / deviation), room.shape)
    normal, size = normals[limit, node], deviation[limit, node]
    # The plane turns with the mean, and the deviation along its normal with the plane.
    ball = event.keep_out[limit]
    assert isinstance(ball, Ball)
    apart = np.linalg.norm(mean[node, :3] - ball.center[node])
    turned = factor[node, :3] @ along[limit, node]
    turned -= normal * (normal @ turned)
    by_mean[node] = room[limit, node] / (size**3 * apart) * turned - normal / size
    by_factor[node, :3] = -room[limit, node] / size**3 * np.outer(normal, along[limit, node])
    return float(room[limit, node] / size), by_mean, by_factor


def _pulled(
    stm: Array, arcs: ArcDerivatives, factor: Array, by_mean: Array, by_factor: Array
) -> Start:
    """Derivatives by a drift's start, from those at its nodes, (n, 3) and (n, 6, c): see the module."""
    last, parameters = len(stm), len(factor) - 6
    by_factor = np.pad(by_factor, ((0, 0), (0, parameters), (0, 0)))
    following = np.cumsum((stm.swapaxes(1, 2) @ by_factor)[::-1], axis=0)[::-1]
    own = np.zeros((last, 6))
    own[:, :3] = by_mean
    if last > 1:
        before = np.linalg.solve(stm[1:].swapaxes(1, 2), following[1:] @ factor.T)
        both = before @ stm[:-1].swapaxes(1, 2)
        own[:-1] += np.einsum("nijl,nij->nl", bending(arcs, parameters), both[:, :6])
    return Start(np.einsum("nij,ni->j", stm[:, :6, :6], own), following[0, :6])


def _last(parts: Array) -> int:
    """The last node with a part that is not zero."""
    return int(np.max(np.nonzero(parts)[0], initial=0))


class DriftRows:
    """Rows of all drifts of a problem; `first` rows come before.

    P3 has none of them: a mean that must pass a region on one side of it would keep P3, and the plan
    after it, on the side of the guess.
    """

    def __init__(self, problem: FlybyProblem, first: int) -> None:
        self._drifts, self._first = problem.drifts, first
        self._branches = dict[int, Branch]()
        self.count = len(problem.drifts)
        after = problem.burn_nodes[[drift.burn for drift in problem.drifts]].astype(np.intp)
        self.nodes: Indices = np.unique(np.r_[after - 1, after]).astype(np.intp)
        self._seen = Seen[list[DriftValue]]()

    def margins(self, lin: Linearisation) -> dict[str, Margins]:
        """Margin of each drift, in standard deviations, at the node of its burn."""
        return {
            drift.name: Margins(
                lin.problem.burn_nodes[[drift.burn]],
                np.array([found.value - drift.required]),
                found.path,
            )
            for drift, found in zip(self._drifts, self.at(lin), strict=True)
        }

    def cones(self, lin: Linearisation) -> list[Cones]:
        """A half-space for each drift, in all controls: curving them was tried, and slows planning."""
        blocks, timed = [], lin.problem.time_controls
        for row, (drift, found) in enumerate(zip(self._drifts, self.at(lin), strict=True)):
            by_states = self._by_states(lin, drift, found)
            slope = gradient(lin, *by_states)
            slope[timed] += self._by_times(lin, drift, found, *by_states)
            constant = found.value - drift.required - slope @ lin.controls
            rows = np.array([self._first + row])
            blocks.append(Cones(rows, slope[None, None], np.full((1, 1), constant)))
        return blocks

    def state_cones(self, lin: Linearisation) -> list[Cones]:
        """The slopes act on mean and factor at the two nodes about each burn."""
        blocks, timed = [], lin.problem.time_controls
        for own, drift, found in zip(self.cones(lin), self._drifts, self.at(lin), strict=True):
            nodes = lin.problem.burn_nodes[drift.burn] - np.array([1, 0])
            by_mean, by_factor = self._by_states(lin, drift, found)
            by_states = np.concatenate([by_mean[nodes, :, None], by_factor[nodes]], axis=2)
            block = on_states(own, lin, np.zeros(2, dtype=np.intp), nodes, by_states)
            left = self._by_times(lin, drift, found, by_mean, by_factor)
            block.values[0, 0, timed] = left
            block.constants[0, 0] -= left @ lin.controls[timed]
            blocks.append(block)
        return blocks

    def at(self, lin: Linearisation) -> list[DriftValue]:
        """Values of all drifts at an iterate."""
        if lin not in self._seen:
            self._seen[lin] = [self._value(lin, number) for number in range(len(self._drifts))]
        return self._seen[lin]

    def _value(self, lin: Linearisation, number: int) -> DriftValue:
        drift = self._drifts[number]
        if number not in self._branches:
            self._branches[number] = branch_at(lin, drift)
        return self._branches[number](start_of(lin, drift))

    def _by_times(
        self, lin: Linearisation, drift: Drift, found: DriftValue, by_mean: Array, by_factor: Array
    ) -> Array:
        """Derivative by times beside that by the states at nodes, which `_by_states` gives, (q,).

        A burn that moves takes the drift along: the node before it moves less than the burn does. The
        drift's own forces stay those of its times.
        """
        if not lin.problem.time_controls.size:
            return np.zeros(0)
        before = int(lin.problem.burn_nodes[drift.burn]) - 1
        node, factor = np.array([before]), lin.spread.factor[before]
        moved, turned = lin.shifts.before(drift.burn, lin.stm_of_arcs[before] @ factor)
        slope = found.by.mean @ moved + np.tensordot(found.by.factor, turned, 2)
        less = by_mean[before] @ lin.shifts.drift(node)[0]
        less += np.tensordot(by_factor[before], lin.shifts.factor_drift(node, factor[None])[0], 2)
        return np.asarray((1.0 - drift.share) * slope - less)

    def _by_states(
        self, lin: Linearisation, drift: Drift, found: DriftValue
    ) -> tuple[Array, Array]:
        """Derivatives by means (n_nodes, 6) and factors (n_nodes, 6, c), from those by the start."""
        k, missed = int(lin.problem.burn_nodes[drift.burn]), 1.0 - drift.share
        by_mean = np.zeros((lin.problem.n_nodes, 6))
        by_factor = np.zeros((len(by_mean), *found.by.factor.shape))
        by_mean[k], by_factor[k] = drift.share * found.by.mean, drift.share * found.by.factor
        stm = lin.arcs.stm[k - 1]
        both = found.by.factor @ lin.spread.factor[k - 1].T
        bent = np.einsum("ijl,ij->l", lin.bending[k - 1], both)
        by_mean[k - 1] = missed * (stm.T @ found.by.mean + bent)
        by_factor[k - 1] = missed * stm.T @ found.by.factor
        return by_mean, by_factor


def branch_at(lin: Linearisation, drift: Drift) -> Branch:
    """Evaluates a drift near an iterate, which may know the drift's path."""
    return Branch(drift, lin.problem.parameters, lin.iterate.drifts.get(drift.name))


def start_of(lin: Linearisation, drift: Drift, factor: Array | None = None) -> Start:
    """Mean and factor at which a drift begins: see `Drift`.

    `factor` are columns at the nodes, (n_nodes, 6 + p, c), other than the covariance factor's.
    """
    k, missed = int(lin.problem.burn_nodes[drift.burn]), 1.0 - drift.share
    mean = missed * lin.arcs.state[k - 1] + drift.share * lin.iterate.mean[k]
    own = lin.spread.factor if factor is None else factor
    before = lin.stm_of_arcs[k - 1] @ own[k - 1]
    return Start(mean, missed * before + drift.share * own[k])
