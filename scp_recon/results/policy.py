"""Hold the policy of a plan with feedback: gains on estimated states, in SI, as arrays and as stored.

At a cut-off the state is measured, with the result y. A Kalman filter along the plan updates its
prediction,

    x <- x + K (y - H x),    K = P H' R^-1,

where R is the covariance of the measurement's error, P that of the estimate's error after the
update, x the estimated deviation from the plan, and H x that of the state. Below it x has the
uncertain parameters, if the filter estimates them; one that considers them has the state alone, and
its P the error that they cause. Until the next cut-off the plan's state-transition matrices
propagate x, and each commanded correction is added to its velocity. The corrected burn is the
planned burn plus gains times the estimates of the state at its own cut-off and all earlier ones:
estimates of parameters are a linear function of these.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Annotated, Any, Self

import numpy as np
from pydantic import Field
from scipy.linalg import solve_triangular

from formulations.arrays import Array
from formulations.linearisation.factor import Innovation, factor_of
from formulations.linearisation.linearisation import Linearisation
from scp_recon.mission.mission import Mission
from scp_recon.planning.plan import Plan
from scp_recon.scenario.fields import Number

SAME = 0.05
"""Relative error of the estimates' information up to which pictures along two paths tell the same."""


@dataclass(frozen=True, eq=False)
class CutOff:
    """Knowledge before one burn; J2000, m and m/s.

    Attributes:
        burn: number of the burn, from 0, among those that are planned.
        cut_off_s: time of its measurement past the epoch, before a burn at that time.
        measurement_covariance: of the measured state, shape (6, 6).
        estimate_covariance: of the estimate's error after the update: of the state, and of q parameters
            that are estimated, in standard deviations before the flight, shape (6 + q, 6 + q).
    """

    burn: int
    cut_off_s: float
    measurement_covariance: Array
    estimate_covariance: Array

    @property
    def kalman_gain(self) -> Array:
        """K = P H' R^-1, shape (6 + q, 6)."""
        of_state = self.estimate_covariance[:6]
        return np.asarray(np.linalg.solve(self.measurement_covariance, of_state).T)

    def noise(self, draws: Array) -> Array:
        """Errors of the measurement, shape (6, flights), from standard normal draws (flights, 6)."""
        return np.linalg.cholesky(self.measurement_covariance) @ draws.T

    @property
    def lost(self) -> Self:
        """The same without the measurement: the filter's estimate stays the predicted one."""
        return replace(self, estimate_covariance=0.0 * self.estimate_covariance)


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

    The iterate's gains act on innovations xi, of which the estimate takes G xi = K (y - H x). So they
    are a lower block triangular map of the estimates.
    """
    problem, feedback = lin.problem, lin.problem.feedback
    if feedback is None:
        return ()
    state, speed = mission.units.state, mission.units.speed_m_s
    units, known = mission.state_units(lin.flown_filter.estimated), lin.flown_filter
    policy, filters = [], _Filters(lin, 6 * len(feedback.burns))
    for j, burn in enumerate(feedback.burns.tolist()):
        stop = 6 * j + 6
        filters.estimated(np.eye(6, 6 * len(feedback.burns), 6 * j))
        gains = filters.commanded(problem.gains_of(lin.iterate, j) @ filters.innovations)[:, :stop]
        error, measurement = known.after(j), feedback.measurement[j]
        policy.append(
            Correction(
                burn=burn,
                cut_off_s=float(mission.times_s[feedback.cut_offs[j]]),
                gains=speed * gains.reshape(3, j + 1, 6).swapaxes(0, 1) / state,
                measurement_covariance=measurement @ measurement.T * np.outer(state, state),
                estimate_covariance=error @ error.T * np.outer(units, units),
            )
        )
    return tuple(policy)


def with_policy(mission: Mission, lin: Linearisation, policy: Policy) -> Linearisation:
    """The same burns with the gains of a policy of all corrected burns: the inverse of `policy_of`."""
    problem, feedback = lin.problem, lin.problem.feedback
    if feedback is None or not policy:
        return lin
    scale = np.tile(mission.units.state, len(policy)) / mission.units.speed_m_s
    gains, filters = np.zeros(feedback.size), _Filters(lin, 6 * len(policy))
    for j, one in enumerate(policy):
        # What a cut-off tells depends on earlier gains alone.
        filters.lin = Linearisation(problem, replace(lin.iterate, gains=gains.copy()), lin.arcs)
        filters.measured(np.eye(6, 6 * len(policy), 6 * j))
        by = np.hstack(list(one.gains)) * scale[: 6 * j + 6]
        own = filters.commanded(by @ filters.estimates)
        first, last = feedback.first_gain[j : j + 2]
        gains[first:last] = own[:, : 6 * j + 6].ravel()
    return Linearisation(problem, replace(lin.iterate, gains=gains), lin.arcs)


def misjudged(mission: Mission, policy: Policy, burns_m_s: Array) -> float:
    """Largest relative error of the estimates' information for pictures along the path of some burns.

    Zero if all corrections have the measurements that these pictures give.
    """
    cut_offs = np.array([one.cut_off_s for one in policy])
    most, found = 0.0, mission.along(burns_m_s).measured_by_pictures(cut_offs)
    for one, factor in zip(policy, found, strict=True):
        known = factor_of(one.estimate_covariance[:6, :6])
        own = np.linalg.solve(factor, known)
        used = np.linalg.solve(np.linalg.cholesky(one.measurement_covariance), known)
        most = max(most, float(np.linalg.norm(own.T @ own - used.T @ used, 2)))
    return most


class _Filters:
    """Estimates at the cut-offs so far as linear functions of q variables, nondimensional.

    Of the best filter, on whose innovations an iterate's gains act, and of the one that flies.

    Args:
        lin: an iterate, whose gains of burns before the next cut-off count.
        q: number of variables.

    Attributes:
        innovations: of the best filter, shape (6 k, q).
        estimates: of the state by the filter that flies, shape (6 k, q).
    """

    def __init__(self, lin: Linearisation, q: int) -> None:
        self.lin, none = lin, np.zeros((0, q))
        self.innovations, self.estimates = none, none
        start = np.zeros((6 + lin.problem.parameters, q))
        self._best, self._flown = start, start  # estimates of state and parameters, the last ones
        self._commands: list[Array] = []

    def estimated(self, state: Array) -> None:
        """Take the flown filter's estimate of the state at the next cut-off, shape (6, q)."""
        best, flown, before, told = self._next()
        own = flown.by_estimate(state - told[:6])
        if flown is not best:
            apart = flown.root @ own + told[:6] - before[:6]
            own = best.axes @ best.axes.T @ solve_triangular(best.root, apart, lower=True)
        self._take(own, before, state)

    def measured(self, innovation: Array) -> None:
        """Take the best filter's innovation at the next cut-off, shape (6, q)."""
        best, flown, before, told = self._next()
        state = before[:6] + best.gain[:6] @ innovation
        if flown is not best:
            apart = best.root @ innovation + before[:6] - told[:6]
            own = solve_triangular(flown.root, apart, lower=True)
            state = told[:6] + flown.gain[:6] @ own
        self._take(innovation, before, state)

    def commanded(self, command: Array) -> Array:
        """Take the correction (3, q) for the last cut-off."""
        self._commands.append(command)
        return command

    def _next(self) -> tuple[Innovation, Innovation, Array, Array]:
        j = len(self._commands)
        best, flown = self.lin.spread.innovations[j], self.lin.flown_filter.innovations[j]
        return best, flown, self._predicted(self._best), self._predicted(self._flown)

    def _take(self, innovation: Array, before: Array, state: Array) -> None:
        best = self.lin.spread.innovations[len(self._commands)]
        parameters = before[6:] + best.gain[6:] @ innovation
        if self.lin.flown_filter.estimated == len(before):
            self._best = self._flown = np.vstack([state, parameters])
        else:
            self._best = np.vstack([before[:6] + best.gain[:6] @ innovation, parameters])
            self._flown = np.vstack([state, 0.0 * parameters])
        self.innovations = np.vstack([self.innovations, innovation])
        self.estimates = np.vstack([self.estimates, state])

    def _predicted(self, estimate: Array) -> Array:
        """An estimate after the last cut-off carried to just before the next one, (6 + p, q)."""
        problem, feedback, j = self.lin.problem, self.lin.problem.feedback, len(self._commands)
        assert feedback is not None
        if j == 0:
            return estimate
        before, node = feedback.cut_offs[j - 1 : j + 1].tolist()
        predicted = transition(self.lin.stm_of_arcs, before, node) @ estimate
        for burn, command in zip(feedback.burns.tolist(), self._commands, strict=False):
            fired = int(problem.burn_nodes[burn])
            if before <= fired < node:
                kick = transition(self.lin.stm_of_arcs, fired, node)[:, 3:6]
                predicted += kick @ command
        return np.asarray(predicted)


def transition(stm: Array, first: int, last: int) -> Array:
    """The state-transition matrix from one node to another, from those of the arcs (n - 1, d, d)."""
    product = np.eye(stm.shape[-1])
    for arc in stm[first:last]:
        product = arc @ product
    return product


# --- as stored in a file ---

Rows = list[list[Number]]


def has_shape(lists: Any, *shape: int) -> bool:
    """Whether nested lists are an array of a shape."""
    if not shape:
        return True
    return len(lists) == shape[0] and all(has_shape(one, *shape[1:]) for one in lists)


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
        predicted_covariance: of the estimate's errors before the measurement, 6 by 6; or 6 + q by
            6 + q with q uncertain parameters that are estimated, in standard deviations.
        estimate_covariance: of the estimate's errors after it, likewise.
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
        size = max(6, len(self.estimate_covariance))
        for name, n in {"measurement": 6, "predicted": size, "estimate": size}.items():
            if not has_shape(getattr(self, f"{name}_covariance"), n, n):
                raise ValueError(f"{name}_covariance must hold {n} by {n} numbers")
        if not has_shape(self.gain, len(self.gain), 3, 6):
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
    speed, spread, known = mission.units.speed_m_s, lin.spread, lin.flown_filter
    units, corrections = mission.state_units(known.estimated), []
    for j, one in enumerate(policy_of(mission, lin)):
        before = known.before[j][: known.estimated] * units[:, None]
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
    """Roots of the summed variances of position, m, and velocity, m/s: the first six rows' own."""
    variance = np.diag(covariance)
    return float(np.sqrt(variance[:3].sum())), float(np.sqrt(variance[3:6].sum()))
