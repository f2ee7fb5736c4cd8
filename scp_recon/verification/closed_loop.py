"""Check flights with corrected burns: covariances, probabilities of the burns' limits, and costs.

Nothing here shares code with the planner.

Let d be a flight's deviation from its plan, x the estimate of d by a Kalman filter along the plan,
and e = d - x the error of the estimate. One matrix holds the covariance of e, x, a bias that all
burns share, and the estimates at all cut-offs so far. Linear maps propagate it:

    between events    e <- Phi e,               x <- Phi x
    measurement       e <- e - K (e + n),       x <- x + K (e + n),    K = P (P + R)^-1
    burn              e <- e + B (errors),      x <- x + B c

where P is the covariance of e, R that of the measurement's error n, and c the gains times the
estimates. Uncertain parameters are constant components of d, e and x; a state is measured alone. A
filter that considers parameters has no gain on them, so that their x stays zero.

Without corrections x is zero, and e is the deviation. The corrections are jointly normal; their
limits and costs are checked by points of that law.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
from scipy.linalg import block_diag, cho_factor, cho_solve

from formulations.arrays import Array
from formulations.problem.execution_errors import VANISHED
from scp_recon.mission.mission import Mission
from scp_recon.physics import geometry
from scp_recon.results.policy import Correction, Policy
from scp_recon.results.solution import Solution
from scp_recon.results.verification import BurnLimit
from scp_recon.scenario.uncertainty import Gates
from scp_recon.verification.consistency import ERRORS, FEW, POINTS, normal_points

NO_BURN_M_S = 1e-6
"""Size below which a burn needs no attitude."""
SIGMA_ERROR = 1e-5
"""Relative tolerance of a correction's standard deviation."""
MEAN_ERROR = 0.02
"""Standard deviations of the total delta-v by which its mean over other draws may differ: twice to
three times what was measured."""
DV99, DV99_ERROR = 0.99, 0.003
"""Share of other draws up to the stored quantile, and by how much it may differ: three standard errors
of the program's draws, whatever the law."""
SAME_M_S = 1e-8
"""Tolerance of velocities in a file."""


@dataclass(frozen=True)
class JointCovariance:
    """The joint covariance of a flight, and the knowledge at its cut-offs; SI, J2000.

    Attributes:
        mission: that is flown.
        policy: its corrections.
        joint: of e and x, with p parameters each, bias, and estimates of the state at k cut-offs, shape
            (13 + 2 p + 6 k, 13 + 2 p + 6 k).
        known: covariances of the errors of what the filter estimates before and after each cut-off so
            far, shape (6 + q, 6 + q).
    """

    mission: Mission
    policy: Policy
    joint: Array
    known: tuple[tuple[Array, Array], ...] = ()

    @classmethod
    def before_burns(cls, mission: Mission, policy: Policy = ()) -> JointCovariance:
        """Spread of the initial state and the parameters, with nothing learnt."""
        initial = mission.initial_factor @ mission.initial_factor.T
        size = 6 + mission.uncertain.count
        joint = np.zeros((2 * size + 1, 2 * size + 1))
        joint[:size, :size] = block_diag(initial, np.eye(size - 6))
        joint[-1, -1] = 1.0
        return cls(mission, policy, joint)

    @property
    def size(self) -> int:
        """Components of a deviation: the state's and the parameters'. The bias follows two of them."""
        return 6 + self.mission.uncertain.count

    @property
    def deviation(self) -> Array:
        """Covariance of the deviation from the plan, shape (6 + p, 6 + p)."""
        n = self.size
        both = self.joint[:n] + self.joint[n : 2 * n]
        return np.asarray(both[:, :n] + both[:, n : 2 * n])

    @property
    def error(self) -> Array:
        """Covariance of the estimate's error, shape (6 + p, 6 + p)."""
        return self.joint[: self.size, : self.size]

    @property
    def commands(self) -> Array:
        """Covariance of the corrections whose cut-offs are past, shape (3 k, 3 k)."""
        gains = np.zeros((3 * len(self.known), len(self.joint)))
        for j, correction in enumerate(self.policy[: len(self.known)]):
            gains[3 * j : 3 * j + 3] = self._by_memory(correction)
        return gains @ self.joint @ gains.T

    def carried(self, stm: Array) -> JointCovariance:
        """The spread after an arc with an STM (6 + p, 6 + p)."""
        carry, n = np.eye(len(self.joint)), self.size
        carry[:n, :n] = carry[n : 2 * n, n : 2 * n] = stm
        return replace(self, joint=carry @ self.joint @ carry.T)

    def measured(self, time_s: float) -> JointCovariance:
        """The spread after the measurement at a time, if there is one."""
        coming = self.policy[len(self.known) :]
        if not coming or coming[0].cut_off_s != time_s:
            return self
        errors = coming[0].measurement_covariance
        size, n, told = len(self.joint), self.size, 6 + self.mission.estimated
        before = self.joint[:told, :told]
        gain = np.zeros((n, 6))
        gain[:told] = cho_solve(cho_factor(self.joint[:6, :6] + errors), self.joint[:6, :told]).T
        update, noise = np.eye(size + 6, size), np.zeros((size + 6, 6))
        update[:n, :6] -= gain
        update[n : 2 * n, :6] = gain
        noise[:n], noise[n : 2 * n] = -gain, gain
        update[size:], noise[size:] = update[n : n + 6], noise[n : n + 6]
        joint = update @ self.joint @ update.T + noise @ errors @ noise.T
        known = (*self.known, (before, joint[:told, :told]))
        return replace(self, joint=joint, known=known)

    def after_burn(self, burn: Array, number: int) -> JointCovariance:
        """The spread after a burn, m/s, shape (3,), by its number from 0, with its correction if any.

        The errors of executing a correction have its second moment, and depend on nothing else.
        """
        change, added, n = np.eye(len(self.joint)), np.zeros((3, 3)), self.size
        gates, fraction = self.mission.scenario.uncertainty.gates, 0.0
        if gates is None:
            fraction = self.mission.scenario.uncertainty.execution_error or 0.0
            added += np.diag((fraction * burn) ** 2)
        else:
            added += gates_covariance(gates, burn)
            change[3:6, 2 * n] = gates.magnitude_bias * burn
        for correction in self.policy:
            if correction.burn == number:
                gains = self._by_memory(correction)
                change[n + 3 : n + 6] += gains
                command = gains @ self.joint @ gains.T
                added += _error_of_correction(gates, fraction, command)
        joint = change @ self.joint @ change.T
        joint[3:6, 3:6] += added
        return replace(self, joint=joint)

    def _by_memory(self, correction: Correction) -> Array:
        """Gains of a correction on the joint vector, shape (3, 13 + 2 p + 6 k)."""
        gains = np.zeros((3, len(self.joint)))
        blocks, first = np.hstack(list(correction.gains)), 2 * self.size + 1
        gains[:, first : first + blocks.shape[1]] = blocks
        return gains


def _error_of_correction(gates: Gates | None, fraction: float, command: Array) -> Array:
    """Covariance of the errors in executing corrections of covariance (3, 3), with the planner's bound.

    By Gates p_p^2 tr(C) I + (s_p^2 + b^2 - p_p^2) C, the second term only where it adds.
    """
    if gates is None:
        return fraction**2 * np.diag(np.diag(command))
    across = gates.pointing_proportional_rad**2
    along = gates.magnitude_proportional**2 + gates.magnitude_bias**2
    return across * np.trace(command) * np.eye(3) + max(along - across, 0.0) * command


def gates_covariance(gates: Gates, burn: Array) -> Array:
    """Covariance Q of a burn, m/s, shape (3, 3), with the planner's bound below its fixed error."""
    size = float(np.linalg.norm(burn))
    if size == 0.0:
        return np.zeros((3, 3))
    fixed = np.array([gates.magnitude_fixed_m_s, gates.pointing_fixed_m_s])
    proportional = np.array([gates.magnitude_proportional, gates.pointing_proportional_rad])
    bound = float(fixed.max())
    if bound > 0.0:
        vanished = VANISHED * bound
        executed = 1.0 - (1.0 - min(size / vanished, 1.0) ** 2) ** 3
        x = np.clip((size**2 - vanished**2) / (bound**2 - vanished**2), 0.0, 1.0)
        direction = float(np.polyval([6.0, -15.0, 10.0, 0.0, 0.0, 0.0], x))
        fixed = np.sqrt(executed) * (bound - direction * (bound - fixed))
    along, across = fixed**2 + (proportional * size) ** 2
    unit = burn / size
    return across * np.eye(3) + (along - across) * np.outer(unit, unit)


def commanded(solution: Solution, covariance: Array) -> Array:
    """Draws of the corrected burns, m/s, shape (POINTS, k, 3), for the corrections' covariance."""
    nominal = solution.burns_m_s[[correction.burn for correction in solution.corrections]]
    return np.asarray(nominal + normal_points(covariance).reshape(POINTS, -1, 3))


def burn_margins(mission: Mission, times_s: Array, burns: Array) -> dict[str, Array]:
    """Margins of burns (..., m, 3) at times (m,): of their size, m/s, and off the Sun line, rad.

    A burn that needs no attitude has an infinite one.
    """
    size = np.linalg.norm(burns, axis=-1)
    angle = geometry.angle(burns, mission.sun_direction(times_s))
    off = np.minimum(angle, np.pi - angle) - np.deg2rad(mission.scenario.battery.delta_v_cone_deg)
    none = mission.units.tolerance(NO_BURN_M_S, "m/s")
    off_sun = np.where(size > none, off, np.inf)
    return {"dv_max": mission.scenario.burns.dv_max_m_s - size, "dv_battery": off_sun}


def burn_limits(mission: Mission, solution: Solution, burns: Array) -> Iterator[BurnLimit]:
    """Probabilities that corrected burns (draws, k, 3) keep their size and stay out of the cones."""
    first = 1 + mission.scenario.burns_flown
    times = np.array([solution.burns[c.burn].t_s for c in solution.corrections])
    margins = burn_margins(mission, times, burns)
    kept = {name: (margin >= 0.0).mean(axis=0).tolist() for name, margin in margins.items()}
    for j, correction in enumerate(solution.corrections):
        for name, shares in kept.items():
            yield BurnLimit(first + correction.burn, name, float(times[j]), shares[j])


def is_kept(limit: BurnLimit, required: float) -> bool:
    """Whether a limit is kept with the required probability, within the accuracy of the draws."""
    p = limit.probability
    return p + FEW + ERRORS * np.sqrt(p * (1.0 - p) / POINTS) >= required


def wrong_costs(
    mission: Mission, solution: Solution, covariance: Array, burns: Array
) -> Iterator[str]:
    """Names of figures in a file's policy that do not follow from its corrections."""
    stored, same = solution.policy, mission.units.tolerance(SAME_M_S, "m/s")
    assert stored is not None
    sigmas = np.sqrt(np.diag(covariance).reshape(-1, 3).sum(axis=1))
    given = np.array([correction.sigma_m_s for correction in stored.corrections])
    if np.any(np.abs(given - sigmas) > SIGMA_ERROR * sigmas + same):
        yield "policy.corrections"
    fixed = np.delete(solution.burns_m_s, [c.burn for c in solution.corrections], axis=0)
    total = np.linalg.norm(fixed, axis=1).sum() + np.linalg.norm(burns, axis=2).sum(axis=1)
    spread = float(total.std())
    if abs(stored.mean_m_s - total.mean()) > MEAN_ERROR * spread + same:
        yield "policy.mean_m_s"
    fewest = float(np.mean(total <= stored.dv99_m_s - same))
    most = float(np.mean(total <= stored.dv99_m_s + same))
    if fewest > DV99 + DV99_ERROR or most < DV99 - DV99_ERROR:
        yield "policy.dv99_m_s"
