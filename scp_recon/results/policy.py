"""Convert the policy of a plan with feedback to gains on estimated states, in SI, and back.

At a cut-off the state is measured, with the result y. A Kalman filter along the plan updates its
prediction,

    x <- x + K (y - x),    K = P R^-1,

where R is the covariance of the measurement's error, P that of the estimate's error after the
update, and x the estimated deviation from the plan. Until the next cut-off the plan's
state-transition matrices propagate x, and each commanded correction is added to its velocity. The
corrected burn is the planned burn plus gains times the estimates of its own cut-off and of all
earlier ones.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from formulations.arrays import Array
from formulations.linearisation.linearisation import Linearisation
from scp_recon.mission.mission import Mission


@dataclass(frozen=True, eq=False)
class CutOff:
    """Knowledge before one burn; J2000, m and m/s.

    Attributes:
        burn: number of the burn, from 0, among those that are planned.
        cut_off_s: time of its measurement past the epoch, before a burn at that time.
        measurement_covariance: of the measured state, shape (6, 6).
        estimate_covariance: of the estimated state's error after the update, shape (6, 6).
    """

    burn: int
    cut_off_s: float
    measurement_covariance: Array
    estimate_covariance: Array

    @property
    def kalman_gain(self) -> Array:
        """K = P R^-1, shape (6, 6)."""
        return np.asarray(np.linalg.solve(self.measurement_covariance, self.estimate_covariance).T)

    def noise(self, draws: Array) -> Array:
        """Errors of the measurement, shape (6, flights), from standard normal draws (flights, 6)."""
        return np.linalg.cholesky(self.measurement_covariance) @ draws.T


@dataclass(frozen=True, eq=False)
class Correction(CutOff):
    """Correction of one burn.

    Attributes:
        gains: on the estimated deviations from the plan at the cut-offs so far, of this correction and
            of all before it, the earliest first, shape (cut-offs, 3, 6).
    """

    gains: Array


Policy = tuple[Correction, ...]
"""Corrections in the order of their cut-offs and burns; none where all burns are fixed."""


def policy_of(mission: Mission, lin: Linearisation) -> Policy:
    """The policy at an iterate of a mission's problem; none where it is solved without feedback.

    The iterate's gains act on innovations xi, of which the estimate takes G xi = K (y - x). So they are
    a lower block triangular map of the estimates.
    """
    problem, spread = lin.problem, lin.spread
    feedback = problem.feedback
    if feedback is None:
        return ()
    state, speed = mission.units.state, mission.units.speed_m_s
    square = np.outer(state, state)
    nodes = feedback.cut_offs.tolist()
    # Innovations and corrections, by the estimates at all cut-offs.
    estimates = np.eye(6 * len(nodes)).reshape(-1, 6, 6 * len(nodes))
    innovations, policy = np.zeros((6 * len(nodes), 6 * len(nodes))), []
    corrections: list[Array] = []
    for j, burn in enumerate(feedback.burns.tolist()):
        stop = 6 * j + 6
        one, change = spread.innovations[j], estimates[j] - _predicted(lin, estimates, corrections)
        innovations[6 * j : stop] = one.by_estimate(change)
        corrections.append(problem.gains_of(lin.iterate, j) @ innovations[:stop])
        gains = corrections[j][:, :stop]
        error = one.updated(spread.stm[nodes[j]] @ spread.errors[j])
        measurement = feedback.measurement[j]
        policy.append(
            Correction(
                burn=burn,
                cut_off_s=float(mission.times_s[nodes[j]]),
                gains=speed * gains.reshape(3, j + 1, 6).swapaxes(0, 1) / state,
                measurement_covariance=measurement @ measurement.T * square,
                estimate_covariance=error @ error.T * square,
            )
        )
    return tuple(policy)


def with_policy(mission: Mission, lin: Linearisation, policy: Policy) -> Linearisation:
    """The same burns with the gains of a policy of all corrected burns: the inverse of `policy_of`."""
    problem, feedback = lin.problem, lin.problem.feedback
    if feedback is None or not policy:
        return lin
    scale = np.tile(mission.units.state, len(policy)) / mission.units.speed_m_s
    gains = np.zeros(feedback.size)
    # Estimates and corrections, by innovations. What a cut-off tells depends on earlier gains alone.
    estimates: list[Array] = []
    corrections: list[Array] = []
    for j, one in enumerate(policy):
        lin = Linearisation(problem, replace(lin.iterate, gains=gains.copy()), lin.arcs)
        own = slice(6 * j, 6 * j + 6)
        estimate = _predicted(lin, [*estimates, np.zeros((6, 6 * len(policy)))], corrections)
        estimate[:, own] = lin.spread.innovations[j].gain
        estimates.append(estimate)
        blocks = np.hstack(list(one.gains)) * scale[: own.stop]
        corrections.append(blocks @ np.vstack(estimates))
        first, last = feedback.first_gain[j : j + 2]
        gains[first:last] = corrections[j][:, : own.stop].ravel()
    return Linearisation(problem, replace(lin.iterate, gains=gains), lin.arcs)


def _predicted(
    lin: Linearisation, estimates: Sequence[Array] | Array, corrections: Sequence[Array]
) -> Array:
    """The estimate just before the next cut-off, shape (6, q), nondimensional.

    Estimates (6, q) and corrections (3, q) so far are given as derivatives by q variables. Only
    estimates at earlier cut-offs count.
    """
    problem, feedback, j = lin.problem, lin.problem.feedback, len(corrections)
    assert feedback is not None
    predicted = np.zeros_like(estimates[0])
    if j == 0:
        return predicted
    before, node = feedback.cut_offs[j - 1 : j + 1].tolist()
    predicted += transition(lin.arcs.stm, before, node) @ estimates[j - 1]
    for burn, correction in zip(feedback.burns.tolist(), corrections, strict=False):
        fired = int(problem.burn_nodes[burn])
        if before <= fired < node:
            predicted += transition(lin.arcs.stm, fired, node)[:, 3:] @ correction
    return predicted


def transition(stm: Array, first: int, last: int) -> Array:
    """The state-transition matrix from one node to another, from those of the arcs (n - 1, 6, 6)."""
    product = np.eye(6)
    for arc in stm[first:last]:
        product = arc @ product
    return product
