"""Verification that shares no code path with the solver.

The plan's burns are flown with an adaptive eighth-order integrator at tight tolerance, the STM by
the variational equations with a complex-step gravity gradient; every original constraint (not its
polytope) is evaluated between the nodes too, and every joint probability is estimated by Monte
Carlo of the nonlinear dynamics. The samples fly with the planner's fixed-step integrator for speed;
some of them are flown again with the adaptive one. Common ground is what defines the problem: the
acceleration, the body's rotation, the Sun's direction and the boundary states.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from scipy.integrate import solve_ivp

from formulations.arrays import Array
from formulations.problem.execution_errors import VANISHED
from scp_recon.mission.mission import Mission
from scp_recon.mission.schedule import MISS_WEIGHT
from scp_recon.monte_carlo.estimates import CONFIDENCE
from scp_recon.monte_carlo.observation_time import observation_margins
from scp_recon.monte_carlo.sampling import fly_block
from scp_recon.physics import geometry
from scp_recon.physics.forces import ForceModel, acceleration
from scp_recon.results.facts import FinalMiss, FinalSigma, MeanMargin, Verification
from scp_recon.results.figures import is_converged
from scp_recon.results.solution import Solution
from scp_recon.scenario.uncertainty import Gates
from scp_recon.verification.consistency import inconsistencies
from scp_recon.verification.probabilities import (
    MARGIN_LIMIT,
    SAMPLES,
    SEED,
    exceeded,
    flown_sigmas,
    joint_probabilities,
    shortfalls,
)

FLIGHTS_CHECKED = 3
MARGIN_STEP_S = 10.0
POSITION_LIMIT_M, VELOCITY_LIMIT_M_S, DEFECT_LIMIT_M = 1.0, 1e-4, 1e-2
COVARIANCE_LIMIT = 1e-6
SAMPLE_LIMIT = 1e-6
"""Of the initial radius, where that is more than a centimetre: 1 sigma is of the order of 1e-2."""
FIGURES = {
    "terminal_position_error_m": ("final position", "m"),
    "terminal_velocity_error_m_s": ("final velocity", "m/s"),
    "max_defect": ("nodes", "m"),
    "sample_error_m": ("sampled flights", "m"),
    "covariance_error": ("covariance, relative", ""),
}
"""Figures of a verification that `limits_of` limits: their names in tables, and units."""
NO_BURN_M_S = 1e-6
SMALLEST = 1e-30
"""Scaled covariance that counts as none."""
DIVERGED = 1e100
"""Stands for what is not finite: the file knows no infinity, and no limit allows it."""


def verify(mission: Mission, solution: Solution) -> Verification:
    """Check a solution against its mission; the answer holds figures and what failed."""
    burns, times = solution.burns_m_s, np.array(solution.nodes.t_s)
    states = np.array(solution.nodes.state)
    fine = np.arange(mission.times_s[0], mission.times_s[-1], MARGIN_STEP_S)
    flown = _fly(mission, burns, np.union1d(times, fine), mission.initial_state)
    at_nodes = np.searchsorted(flown.times, times)
    stored = np.array(solution.nodes.covariance)
    defects = np.abs(flown.states[at_nodes] - states) / mission.units.state * mission.units.length_m
    final = np.abs(flown.states[-1] - mission.final_state)
    missed = None if mission.must_meet else final_miss(mission, final)
    margins = [*_burn_margins(mission, burns), *_mean_margins(mission, flown)]
    probabilities = joint_probabilities(mission, burns)
    figures = {
        "terminal_position_error_m": _finite(np.linalg.norm(final[:3])),
        "terminal_velocity_error_m_s": _finite(np.linalg.norm(final[3:])),
        "max_defect": _finite(defects.max()),
        "sample_error_m": _sample_error(mission, burns),
        "covariance_error": _covariance_error(mission, stored, flown.covariances[at_nodes]),
    }
    limits = limits_of(mission)
    failed = [name for name, value in figures.items() if value > limits[name]]
    failed += inconsistencies(mission, solution)
    if not is_converged(solution) and "status" not in failed:
        failed.append("status")
    failed += [m.name for m in margins if m.worst_margin < MARGIN_LIMIT[m.unit]]
    sigmas: list[FinalSigma] = []
    if solution.problem == "P2":
        failed += shortfalls(mission, solution, probabilities)
        sigmas = flown_sigmas(mission, burns, SEED)
        failed += exceeded(sigmas)
    return Verification(
        **figures,
        mean_margins=margins,
        samples=SAMPLES,
        confidence=CONFIDENCE,
        probabilities=probabilities,
        failed=failed,
        missed=missed,
        final_sigmas=tuple(sigmas),
        ok=not failed,
    )


def limits_of(mission: Mission) -> dict[str, float]:
    """Limits of a verification, by the figures' names, in their units.

    The miss of a final state that too few burns are left to meet is said and not judged: infinity.
    """
    missed = not mission.must_meet
    return {
        "terminal_position_error_m": np.inf if missed else POSITION_LIMIT_M,
        "terminal_velocity_error_m_s": np.inf if missed else VELOCITY_LIMIT_M_S,
        "max_defect": DEFECT_LIMIT_M,
        "sample_error_m": max(DEFECT_LIMIT_M, SAMPLE_LIMIT * mission.units.length_m),
        "covariance_error": COVARIANCE_LIMIT,
    }


def final_miss(mission: Mission, miss: Array) -> FinalMiss:
    """Miss of the final state, from J2000, m and m/s, shape (6,), with its weighed charge."""
    weighed = MISS_WEIGHT * np.abs(miss / mission.units.state).sum() * mission.units.speed_m_s
    return FinalMiss(
        position_m=_finite(np.linalg.norm(miss[:3])),
        velocity_m_s=_finite(np.linalg.norm(miss[3:])),
        weighted_m_s=_finite(weighed),
    )


@dataclass(frozen=True)
class _Flown:
    """A re-integrated flight, after the burns: times (n,), states (n, 6), covariances (n, 6, 6)."""

    times: Array
    states: Array
    covariances: Array


def _fly(mission: Mission, burns: Array, times: Array, initial: Array) -> _Flown:
    """Burn to burn, so that the integrator never steps over a jump; from a state before them."""
    start, firing = mission.scenario.start_s, mission.scenario.burn_times_s
    stops = firing if firing[0] == start else (start, *firing)
    burns = np.vstack([np.zeros((len(stops) - len(firing), 3)), burns])  # none where it coasts
    times = np.union1d(times, stops)
    states = np.full((len(times), 6), DIVERGED)  # for what the integrator does not reach
    covariances = np.full((len(times), 6, 6), DIVERGED)
    state, spread = initial.copy(), Spread.before_burns(mission)
    for i, begin in enumerate(stops):
        state[3:] += burns[i]
        spread = spread.after_burn(mission, burns[i])
        if i + 1 == len(stops):
            break
        # The leg's last time is overwritten by the next leg's first, after the burn.
        leg = (times >= begin) & (times <= stops[i + 1])
        answer = integrated(mission, state, (begin, stops[i + 1]), t_eval=times[leg])
        if not answer.success:
            return _Flown(times, states, covariances)
        stm = answer.y[6:].T.reshape(-1, 6, 6)
        states[leg] = answer.y[:6].T
        covariances[leg] = stm @ spread.covariance @ stm.transpose(0, 2, 1)
        state, spread = states[leg][-1].copy(), spread.carried(stm[-1])
    states[-1], covariances[-1] = state, spread.covariance
    return _Flown(times, states, covariances)


def integrated(mission: Mission, state: Array, span: tuple[float, float], **looks: Any) -> Any:
    """SciPy's answer for the state and the flattened STM, shape (42,), from one time to another.

    `looks` says where it is looked at, as `solve_ivp` takes it.
    """
    return solve_ivp(
        lambda _, y: variational_rate(y, mission.forces),
        span,
        np.concatenate([state, np.eye(6).ravel()]),
        method="DOP853",
        rtol=1e-12,
        atol=1e-13 * np.concatenate([mission.units.state, np.ones(36)]),
        **looks,
    )


def variational_rate(y: Array, forces: ForceModel) -> Array:
    """d/dt of the state and the flattened STM, shape (42,).

    The gravity gradient is a complex step of the acceleration: exact to roundoff and independent of
    the closed forms that the planner uses.
    """
    step = 1e-20
    r = y[:3, None] + 1j * step * np.eye(3)
    columns = np.stack(acceleration(r[0], r[1], r[2], forces))
    stm = y[6:].reshape(6, 6)
    stm_rate = np.concatenate([stm[3:], columns.imag / step @ stm[:3]])
    return np.concatenate([y[3:6], columns.real[:, 0], stm_rate.ravel()])


def _sample_error(mission: Mission, burns: Array) -> float:
    """Largest difference of some sampled flights from the adaptive integration of the same, m."""
    times = mission.times_s[[0, *mission.window_nodes, -1]]
    sampled = fly_block(mission, burns, times, 0, flights=FLIGHTS_CHECKED, seed=SEED)
    errors = []
    for i, executed in enumerate(sampled.burns_m_s):
        initial = sampled.states[0, i].copy()
        if not mission.problem.coasts:
            initial[3:] -= executed[0]
        again = _fly(mission, executed, times, initial)
        looked = np.searchsorted(again.times, times)
        errors.append(np.abs(again.states[looked] - sampled.states[:, i]) / mission.units.state)
    return _finite(np.max(errors) * mission.units.length_m)


def _finite(figure: np.floating) -> float:
    return float(np.nan_to_num(figure, nan=DIVERGED, posinf=DIVERGED))


def _covariance_error(mission: Mission, stored: Array, flown: Array) -> float:
    """Largest error of a node's covariance relative to its largest entry, in scaled units."""
    units = np.outer(mission.units.state, mission.units.state)
    return relative_error(stored / units, flown / units)


def relative_error(given: Array, exact: Array) -> float:
    """Largest error of nondimensional covariances (n, 6, 6), relative to each one's largest entry."""
    size = np.abs(exact).max(axis=(1, 2))
    error = np.abs(given - exact).max(axis=(1, 2))
    return _finite((error / np.maximum(size, SMALLEST)).max())


def _mean_margins(mission: Mission, flown: _Flown) -> list[MeanMargin]:
    """Margins of every original constraint, between the nodes too."""
    first, last = mission.observed_s or (np.inf, np.inf)
    window = (flown.times >= first) & (flown.times <= last)
    times = flown.times[window]
    margins = observation_margins(mission, times, flown.states[window, :3])
    radius = np.linalg.norm(flown.states[:, :3], axis=1) - mission.scenario.safety.radius_min_m
    observed = margins.items() if len(times) else ()
    seen = [_worst(name, unit, times, margin) for name, (unit, margin) in observed]
    return [_worst("safety_radius", "m", flown.times, radius), *seen]


def _burn_margins(mission: Mission, burns: Array) -> list[MeanMargin]:
    """Size of the planned burns and their angle from the Sun line, either way."""
    times = np.array(mission.scenario.burn_times_s)
    size = np.linalg.norm(burns, axis=1)
    angle = geometry.angle(burns, mission.sun_direction(times))
    cone = np.deg2rad(mission.scenario.battery.delta_v_cone_deg)
    # A burn of next to nothing needs no attitude.
    off_sun = np.where(size > NO_BURN_M_S, np.minimum(angle, np.pi - angle) - cone, np.inf)
    margins = [_worst("dv_max", "m/s", times, mission.scenario.burns.dv_max_m_s - size)]
    if np.isfinite(off_sun).any():
        margins.append(_worst("dv_battery", "rad", times, off_sun))
    return margins


def _worst(name: str, unit: Literal["m", "rad", "m/s"], times: Array, margin: Array) -> MeanMargin:
    at = int(np.argmin(margin))
    return MeanMargin(name, float(margin[at]), unit, float(times[at]))


@dataclass(frozen=True)
class Spread:
    """Covariance of a flight by what burns add to it, in closed form: no factor, no columns.

        Sigma+ = Sigma + B Q(v) B',
        Q(v) = along^2 u u' + across^2 (I - u u')   (Gates),   beta^2 diag(v)^2   (componentwise)

    A bias that burns share correlates with the state: c is its covariance with the state, and a burn
    adds B b v c' + c (B b v)' + b^2 B v v' B' to Sigma, and B b v to c.

    Attributes:
        covariance: of the state, SI, J2000, shape (6, 6).
        with_bias: covariance of the state with the bias over its sigma, shape (6,).
    """

    covariance: Array
    with_bias: Array

    @classmethod
    def before_burns(cls, mission: Mission) -> Spread:
        """Spread of the initial state."""
        return cls(mission.initial_factor @ mission.initial_factor.T, np.zeros(6))

    def after_burn(self, mission: Mission, burn: Array) -> Spread:
        """With the errors of a burn, m/s, shape (3,)."""
        uncertainty, covariance = mission.scenario.uncertainty, self.covariance.copy()
        if uncertainty.gates is None:
            assert uncertainty.execution_error is not None
            covariance[3:, 3:] += np.diag((uncertainty.execution_error * burn) ** 2)
            return Spread(covariance, self.with_bias)
        covariance[3:, 3:] += gates_covariance(uncertainty.gates, burn)
        bias = uncertainty.gates.magnitude_bias * np.concatenate([np.zeros(3), burn])
        cross = np.outer(bias, self.with_bias)
        covariance += cross + cross.T + np.outer(bias, bias)
        return Spread(covariance, self.with_bias + bias)

    def carried(self, stm: Array) -> Spread:
        """Over an arc with an STM (6, 6)."""
        return Spread(stm @ self.covariance @ stm.T, stm @ self.with_bias)


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
