"""Rows of P2 for the limits on corrected burns, each kept with a probability.

A corrected burn commands v + U xi. It must be no larger than `dv_max` with the probability p of
`Feedback`. It must be outside the battery's double cone with the same probability. Margins are
quantiles in units of speed,

    dv_max - r,  P(|v + U xi| <= r) = p,      t,  P(inside(v + U xi) > -t) = 1 - p,

where inside is the signed distance of `regions`, and the probabilities of the two nappes are added.
Without a correction the margins equal the distances to the limits. They are smoother than
probabilities: the quantile of a ball scales with v and U.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from scipy.special import ndtr, ndtri

from formulations.arrays import Array, Indices
from formulations.linearisation.linearisation import Linearisation, Seen, Sensitivity
from formulations.problem.controls import Feedback
from formulations.problem.flyby import FlybyProblem
from formulations.problem.regions import Ball, Cone
from formulations.risk.lines import normal_density
from formulations.rows.cones import Cones, FinalSpread, Margins
from formulations.rows.drift import DriftRows
from formulations.rows.node_probability import LEAST, Event, Quantiles, node_quantiles

SIZE, BATTERY = "dv_max_corrected", "dv_battery_corrected"

CERTAIN, LEAN = 1e-9, 1e-6
"""Standard deviation that is added to each component, so that certain burns have a gradient, and its
least share in the correction's, so that corrections along a line have one."""

SCALE = 1e6
"""Scale of velocities in `node_quantiles`, so large that the variance added there does not matter."""

BEYOND = 4.0
"""Deviations beyond the quantile within which a margin is looked for."""

STEPS, CLOSE = 60, 1e-6
"""Most steps of Newton's method to a margin, and what is near enough, in standard deviations."""

ROUNDING = 1e-15
"""Rounding of a margin, over the largest velocities: smaller steps have no effect."""


class Level(NamedTuple):
    """Phi^-1 of the probability to keep limits by x, shape (n,), and its derivative by x, negative."""

    quantile: Quantiles
    by_x: Array


LevelAt = Callable[[Array, Array, Array], Level]
"""Makes the level at velocities (n, 3), factors (n, 3, c) and x (n,)."""


class CorrectedBurns:
    """Rows of the corrected burns' limits, each a cone in the controls; `first` rows come before."""

    def __init__(self, problem: FlybyProblem, first: int) -> None:
        self._problem, self._first = problem, first
        limits, feedback = 1 + int(problem.dv_cone > 0.0), problem.feedback
        self.count = 0 if feedback is None else limits * len(feedback.burns)
        self._seen = Seen[dict[str, Quantiles]]()

    def margins(self, lin: Linearisation) -> dict[str, Margins]:
        """Margins at the corrected burns' nodes, in units of speed."""
        feedback = self._problem.feedback
        if feedback is None:
            return {}
        nodes = self._problem.burn_nodes[feedback.burns]
        return {name: Margins(nodes, at.value) for name, at in self._at(lin).items()}

    def cones(self, lin: Linearisation) -> list[Cones]:
        """A block for each row, exact to first order.

        Bent like the margin of a half-space, distance less q ||a'U||, a the direction of the limit.
        """
        problem, feedback = self._problem, self._problem.feedback
        if feedback is None:
            return []
        q, z = float(ndtri(feedback.probability)), lin.controls
        blocks: list[Cones] = []
        for at in self._at(lin).values():
            for j, burn in enumerate(feedback.burns):
                own, p = problem.commanded_controls(j), problem.controls_before[burn + 1]
                gains = problem.gains_of(lin.iterate, j)
                by_gains = at.by_factor[j, :, : gains.shape[1]]
                along = at.by_mean[j] @ gains
                # ||a'U|| with the certain part, which keeps the derivative finite.
                spread = np.hypot(np.linalg.norm(along), CERTAIN)
                values = np.zeros((1, 1 + gains.shape[1], p))
                values[0, 0, own.start : own.start + 3] = at.by_mean[j]
                slope = by_gains + q * np.outer(at.by_mean[j], along) / spread
                values[0, 0, own.start + 3 : own.stop] = slope.ravel()
                tail = np.einsum("i,cd->cid", q * at.by_mean[j], np.eye(gains.shape[1]))
                values[0, 1:, own.start + 3 : own.stop] = tail.reshape(gains.shape[1], -1)
                constants = np.zeros((1, 1 + gains.shape[1]))
                constants[0, 0] = at.value[j] + q * spread - values[0, 0] @ z[:p]
                blocks.append(Cones(np.array([self._first + len(blocks)]), values, constants))
        return blocks

    def _at(self, lin: Linearisation) -> dict[str, Quantiles]:
        """Margins and their derivatives by the burns and their gains."""
        if lin not in self._seen:
            feedback = self._problem.feedback
            assert feedback is not None
            which, k = feedback.burns, len(feedback.burns)
            gains = np.zeros((k, 3, 6 * k))
            for j in range(k):
                gains[j, :, : 6 * (j + 1)] = self._problem.gains_of(lin.iterate, j)
            self._seen[lin] = margins_of(self._problem, which, lin.iterate.burns[which], gains)
        return self._seen[lin]


def margins_of(
    problem: FlybyProblem, which: Indices, burns: Array, gains: Array
) -> dict[str, Quantiles]:
    """Margins of some burns (k, 3) with gains (k, 3, n), by limit, and their derivatives.

    Those by the gains have shape (k, 3, n + 3): the last three columns are by the certain part.
    """
    assert problem.feedback is not None
    certain = certain_part(gains)[:, None, None] * np.eye(3)
    given = burns, np.concatenate([gains, certain], axis=2), problem.feedback
    found = {SIZE: _margins(_within_size, -np.linalg.norm(burns, axis=1), *given)}
    found[SIZE].value[:] += problem.dv_max
    if problem.dv_cone > 0.0:
        sun = problem.sun[which]
        nappes = (Cone(np.zeros_like(sun), side * sun, problem.dv_cone) for side in (1.0, -1.0))
        off = np.min([-nappe.inside(burns) for nappe in nappes], axis=0)
        found[BATTERY] = _margins(_off_cone(sun, problem.dv_cone), off, *given)
    return found


def certain_part(gains: Array) -> Array:
    """Standard deviation that is added to each component of burns with gains (k, 3, n), shape (k,)."""
    return np.maximum(CERTAIN, LEAN * np.linalg.norm(gains, axis=(1, 2)))


def _within_size(velocity: Array, factor: Array, x: Array) -> Level:
    """Level of sizes up to -x: the ball is fixed, and velocity and factor are scaled to it."""
    n, scale = len(velocity), SCALE / -x
    ball = Event("", np.arange(n), (Ball(np.zeros((n, 3)), SCALE),), ())
    v, s = scale[:, None] * velocity, scale[:, None, None] * factor
    g = node_quantiles(ball, v, s)
    by_x = -np.einsum("ni,ni->n", g.by_mean, v) / x
    by_x -= np.einsum("nic,nic->n", g.by_factor, s) / x
    own = scale[:, None] * g.by_mean, scale[:, None, None] * g.by_factor
    return Level(Quantiles(g.value, *own), by_x)


def _off_cone(sun: Array, half_angle: float) -> LevelAt:
    """Level of velocities farther than x from both nappes, by moving the velocities."""
    axes, n = np.concatenate([sun, -sun]), len(sun)
    nappes = Event("", np.arange(2 * n), (), (Cone(np.zeros((2 * n, 3)), axes, half_angle),))

    def level(velocity: Array, factor: Array, x: Array) -> Level:
        moved = np.tile(x, 2)[:, None] / np.sin(half_angle) * axes
        both = SCALE * (np.tile(velocity, (2, 1)) + moved), SCALE * np.tile(factor, (2, 1, 1))
        each = node_quantiles(nappes, *both)
        g = each.value.reshape(2, n)
        missed = ndtr(-g).sum(axis=0)
        seen = (missed > LEAST) & (missed < 1.0 - LEAST)
        both_held = -ndtri(np.clip(missed, LEAST, 1.0 - LEAST))
        value = np.where(seen, both_held, g.min(axis=0))
        nearest = np.arange(2)[:, None] == g.argmin(axis=0)
        share = SCALE * np.where(seen, normal_density(g) / normal_density(both_held), nearest)
        by_mean = share[..., None] * each.by_mean.reshape(2, n, 3)
        by_factor = share[..., None, None] * each.by_factor.reshape(2, *factor.shape)
        by_x = np.einsum("lni,lni->n", by_mean, axes.reshape(2, n, 3)) / np.sin(half_angle)
        return Level(Quantiles(value, by_mean.sum(axis=0), by_factor.sum(axis=0)), by_x)

    return level


def _margins(
    level: LevelAt, certain: Array, velocity: Array, factor: Array, feedback: Feedback
) -> Quantiles:
    """The x that are kept with the required probability, and derivatives, by Newton's method.

    The method is bracketed, and begins a little below the margins of the nominal burns, `certain`.
    """
    q, spread = float(ndtri(feedback.probability)), np.linalg.norm(factor, axis=(1, 2))
    reach = np.linalg.norm(velocity, axis=1) + (abs(q) + BEYOND) * spread
    low, high, x = -reach, reach, certain - 0.5 * q * spread
    for _ in range(STEPS):
        g, by_x = level(velocity, factor, x)
        off = g.value - q
        open_ = np.abs(off) > np.maximum(CLOSE, ROUNDING * reach * np.abs(by_x))
        if not open_.any():
            x = x - off / by_x  # which leaves the square of what is open
            break
        high, low = np.where(off < 0.0, x, high), np.where(off > 0.0, x, low)
        with np.errstate(divide="ignore", invalid="ignore"):
            following = x - off / by_x
        inside = (following > low) & (following < high)
        x = np.where(open_, np.where(inside, following, 0.5 * (low + high)), x)
    return Quantiles(x, -g.by_mean / by_x[:, None], -g.by_factor / by_x[:, None, None])


class FurtherRows:
    """Rows after all others of a problem: `FinalSpread`, then `CorrectedBurns`, then `DriftRows`.

    `first` is the number of rows before. Each row has a block of its own in `cones`.
    """

    def __init__(self, problem: FlybyProblem, first: int) -> None:
        self._final = FinalSpread(problem, first)
        self._burns = CorrectedBurns(problem, first + self._final.count)
        self._drifts = DriftRows(problem, first + self._final.count + self._burns.count)
        self.nodes: Indices = np.union1d(self._final.nodes, self._drifts.nodes)
        self.count = self._final.count + self._burns.count + self._drifts.count

    def margins(self, lin: Linearisation) -> dict[str, Margins]:
        """Margins of all these rows."""
        return self._final.margins(lin) | self._burns.margins(lin) | self._drifts.margins(lin)

    def cones(self, lin: Linearisation, s: Sensitivity) -> list[Cones]:
        """One cone per row, in all controls; `s` ends with the last node if the spread is limited."""
        return self._final.cones(lin, s) + self._burns.cones(lin) + self._drifts.cones(lin)

    def state_cones(self, lin: Linearisation) -> list[Cones]:
        """Cones of all these rows; those of burns have no entry of a state."""
        own = self._final.state_cones() + self._burns.cones(lin)
        return own + self._drifts.state_cones(lin)
