"""Hold the policy of a plan with feedback: gains on estimated states, in SI, as arrays and as stored.

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
from typing import Annotated

import numpy as np
from pydantic import Field

from formulations.arrays import Array
from formulations.linearisation.linearisation import Linearisation
from scp_recon.mission.mission import Mission
from scp_recon.planning.plan import Plan
from scp_recon.scenario.fields import Number


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


# --- as stored in a file ---

Rows = list[list[Number]]


@dataclass(frozen=True)
class CorrectedBurn:
    """One corrected burn: its nominal value and, for each cut-off so far, a gain times an estimate.

    An estimate is the deviation from the plan at a cut-off, by a Kalman filter along the plan, after
    the measurement there; corrections commanded before are part of it.

    Attributes:
        burn: its number, from 1.
        cut_off_s: time of its measurement past the epoch, before a burn at that time.
        gain: 3 by 6 for each cut-off so far, the earliest first: m/s by m and by m/s.
        measurement_covariance: of the measured state's errors, 6 by 6.
        predicted_covariance: of the estimate's errors before the measurement, 6 by 6.
        estimate_covariance: of the estimate's errors after it, 6 by 6.
        sigma_m_s: root of the summed variances of the correction.
    """

    burn: Annotated[int, Field(ge=1)]
    cut_off_s: Number
    gain: list[Rows]
    measurement_covariance: Rows
    predicted_covariance: Rows
    estimate_covariance: Rows
    sigma_m_s: Annotated[float, Field(ge=0)]

    def __post_init__(self) -> None:
        """Refuse arrays of other shapes."""
        for name in ("measurement", "predicted", "estimate"):
            rows = getattr(self, f"{name}_covariance")
            if len(rows) != 6 or any(len(row) != 6 for row in rows):
                raise ValueError(f"{name}_covariance must hold 6 by 6 numbers")
        if any(len(block) != 3 or any(len(row) != 6 for row in block) for block in self.gain):
            raise ValueError("gain must hold 3 by 6 numbers for each cut-off so far")


@dataclass(frozen=True)
class StoredPolicy:
    """Corrected burns, and the law of the delta-v that they command.

    Attributes:
        corrections: one for each corrected burn.
        mean_m_s: mean of the commanded burns' sizes, summed; `total_dv_m_s` is that of the plan itself.
        dv99_m_s: its 99 % quantile, by the program's draws.
    """

    corrections: list[CorrectedBurn]
    mean_m_s: Annotated[float, Field(ge=0)]
    dv99_m_s: Annotated[float, Field(ge=0)]

    def __str__(self) -> str:
        """Its commanded delta-v in one line."""
        mean, most = 1e3 * self.mean_m_s, 1e3 * self.dv99_m_s
        return f"commanded delta-v, by the normal law: mean {mean:.3f} mm/s, 99 % {most:.3f} mm/s"

    def __post_init__(self) -> None:
        """Refuse corrections out of order, or with more or fewer gains than cut-offs so far."""
        burns = [correction.burn for correction in self.corrections]
        cut_offs = [correction.cut_off_s for correction in self.corrections]
        if not burns or any(sorted(set(given)) != given for given in (burns, cut_offs)):
            raise ValueError("corrections must be of ascending burns and cut-offs, one at least")
        if any(len(c.gain) != j for j, c in enumerate(self.corrections, start=1)):
            raise ValueError("gain must have one block for each cut-off so far")


def stored_policy(plan: Plan) -> StoredPolicy | None:
    """The policy of a plan; None where its burns are fixed before departure."""
    mission, lin = plan.mission, plan.final.result.lin
    feedback, scenario = lin.problem.feedback, plan.mission.scenario
    if feedback is None or plan.commanded is None:
        return None
    speed, spread = mission.units.speed_m_s, lin.spread
    corrections = []
    for j, one in enumerate(policy_of(mission, lin)):
        before = spread.stm[feedback.cut_offs[j]] @ spread.errors[j] * mission.units.state[:, None]
        innovations = np.vstack([each.rows for each in spread.innovations[: j + 1]])
        command = lin.problem.gains_of(lin.iterate, j) @ innovations
        corrections.append(
            CorrectedBurn(
                burn=one.burn + 1 + scenario.burns_flown,
                cut_off_s=one.cut_off_s,
                gain=one.gains.tolist(),
                measurement_covariance=one.measurement_covariance.tolist(),
                predicted_covariance=(before @ before.T).tolist(),
                estimate_covariance=one.estimate_covariance.tolist(),
                sigma_m_s=float(speed * np.linalg.norm(command)),
            )
        )
    return StoredPolicy(corrections, *plan.commanded)


def policy_in(stored: StoredPolicy | None, burns_flown: int) -> Policy:
    """The stored policy in arrays; none where all burns are fixed."""
    return tuple(
        Correction(
            burn=c.burn - 1 - burns_flown,
            cut_off_s=c.cut_off_s,
            gains=np.array(c.gain),
            measurement_covariance=np.array(c.measurement_covariance),
            estimate_covariance=np.array(c.estimate_covariance),
        )
        for c in (stored.corrections if stored is not None else ())
    )


def sigmas(covariance: Array) -> tuple[float, float]:
    """Roots of the summed variances of position, m, and velocity, m/s, of a covariance (6, 6)."""
    variance = np.diag(covariance)
    return float(np.sqrt(variance[:3].sum())), float(np.sqrt(variance[3:].sum()))
