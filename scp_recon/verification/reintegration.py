"""Verify a solution without any code of the solver.

An adaptive eighth-order integrator with a tight tolerance flies the plan's burns. The STM comes
from the variational equations with a complex-step gravity gradient. Every original constraint (not
its polytope) is evaluated at and between the nodes. Every joint probability is estimated by Monte
Carlo of the nonlinear dynamics. For speed the samples fly with the planner's fixed-step integrator;
some of them are flown again with the adaptive one. Only the definition of the problem is shared
with the planner: the acceleration, the body's rotation, its companion's orbit, the Sun's direction
and the boundary states.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from scipy.integrate import solve_ivp

from formulations.arrays import Array, Indices
from formulations.linearisation.dynamics import Dynamics
from scp_recon.jobs.cores import beside
from scp_recon.mission.constraints import drift_times, planned_misses, safety_margins
from scp_recon.mission.mission import Mission
from scp_recon.mission.schedule import MISS_WEIGHT
from scp_recon.monte_carlo.estimates import CONFIDENCE
from scp_recon.monte_carlo.limits import MEAN_TOLERANCE
from scp_recon.monte_carlo.observation_time import observation_margins
from scp_recon.monte_carlo.sampling import Flyer
from scp_recon.physics import geometry
from scp_recon.physics.forces import ForceModel, Moment, acceleration
from scp_recon.results.figures import is_converged, is_strange
from scp_recon.results.policy import Policy
from scp_recon.results.solution import Solution
from scp_recon.results.verification import (
    BurnLimit,
    FinalMiss,
    FinalSigma,
    MeanMargin,
    Verification,
)
from scp_recon.verification.closed_loop import (
    NO_BURN_M_S,
    JointCovariance,
    burn_limits,
    commanded,
    is_kept,
    wrong_costs,
)
from scp_recon.verification.consistency import inconsistencies
from scp_recon.verification.probabilities import (
    SAMPLES,
    SEED,
    drift_safety,
    exceeded,
    flown_sigmas,
    joint_probabilities,
    lost_contacts,
    refuted,
    wider_than_law,
)

FLIGHTS_CHECKED = 3
MARGIN_LIMIT = MEAN_TOLERANCE | {"m/s": 1e-6}
"""Amount by which a constraint on the mean that binds at nodes may be violated."""
MARGIN_STEP_S = 10.0
POSITION_LIMIT_M, VELOCITY_LIMIT_M_S, DEFECT_LIMIT_M = 1.0, 1e-4, 1e-2
"""At the default mission's scale, as all tolerances in m and m/s: see `Units.tolerance`."""
EXECUTED = 1e-4
"""Share of the smallest executed burn by which a burn may be smaller: the accuracy of the solver."""
COVARIANCE_LIMIT = 1e-6
FIGURES = {
    "terminal_position_error_m": ("final position", "m"),
    "terminal_velocity_error_m_s": ("final velocity", "m/s"),
    "max_defect": ("nodes", "m"),
    "sample_error_m": ("sampled flights", "m"),
    "covariance_error": ("covariance, relative", ""),
    "knowledge_error": ("covariance of estimates, relative", ""),
    "drift_error_m": ("planned drifts", "m"),
}
"""Figures of a verification that `limits_of` limits: their names in tables, and units."""
SMALLEST = 1e-30
"""Scaled covariance that counts as none."""
DIVERGED = 1e100
"""Replaces figures that are not finite: the file has no infinity, and no limit allows this number."""


def verify(mission: Mission, solution: Solution) -> Verification:
    """Check a solution against its mission; the answer holds figures and what failed."""
    burns, times = solution.burns_m_s, np.array(solution.nodes.t_s)
    states = np.array(solution.nodes.state)
    fine = np.arange(mission.times_s[0], mission.times_s[-1], MARGIN_STEP_S)
    policy = () if is_strange(mission, solution.policy) else solution.corrections
    with beside(lambda: joint_probabilities(mission, burns, policy)) as coming:
        flown = _fly(mission, burns, np.union1d(times, fine), mission.initial_state, policy)
        sample_error = _sample_error(mission, burns, policy)
        probabilities, ends = coming()
    at_nodes = np.searchsorted(flown.times, times)
    stored = np.array(solution.nodes.covariance)
    defects = np.abs(flown.states[at_nodes] - states) / mission.units.state * mission.units.length_m
    final = np.abs(flown.states[-1] - mission.final_state)
    missed = None if mission.must_meet else final_miss(mission, final)
    margins = [*_burn_margins(mission, burns), *_mean_margins(mission, flown)]
    figures = {
        "terminal_position_error_m": _finite(np.linalg.norm(final[:3])),
        "terminal_velocity_error_m_s": _finite(np.linalg.norm(final[3:])),
        "max_defect": _finite(defects.max()),
        "sample_error_m": sample_error,
        "covariance_error": _covariance_error(mission, stored, flown.covariances[at_nodes]),
    }
    if mission.uncertain.count:
        figures["covariance_error"] = max(
            figures["covariance_error"],
            _parameter_error(mission, solution, flown.parameters[at_nodes]),
        )
    if policy:
        figures["knowledge_error"] = _knowledge_error(mission, solution, flown, at_nodes)
    if solution.problem == "P2" and mission.problem.drifts:
        figures["drift_error_m"] = _drift_error(mission, states, burns)
    limits = limits_of(mission)
    failed = [name for name, value in figures.items() if value > limits[name]]
    failed += inconsistencies(mission, solution)
    if not is_converged(solution) and "status" not in failed:
        failed.append("status")
    failed += [
        m.name
        for m in margins
        if m.worst_margin < -mission.units.tolerance(MARGIN_LIMIT[m.unit], m.unit)
    ]
    failed += not_executed(mission, solution)
    on_burns: list[BurnLimit] = []
    if policy and len(flown.end.known) == len(policy):  # else the flight has no end
        covariance = flown.end.commands
        draws = commanded(solution, covariance)
        failed += wrong_costs(mission, solution, covariance, draws)
        on_burns += burn_limits(mission, solution, draws)
        failed += [str(b) for b in on_burns if not is_kept(b, mission.scenario.risk.p_chance)]
    sigmas: list[FinalSigma] = []
    if solution.problem == "P2":
        failed += refuted(mission, solution, probabilities)
        sigmas = flown_sigmas(mission, burns, SEED, policy)
        failed += exceeded(sigmas)
    drifts = drift_safety(mission, burns, policy, planned=solution.problem == "P2")
    failed += [one.check for one in drifts if one.is_refuted]
    return Verification(
        **figures,
        mean_margins=margins,
        samples=SAMPLES,
        confidence=CONFIDENCE,
        probabilities=probabilities,
        failed=list(dict.fromkeys(failed)),
        missed=missed,
        final_sigmas=tuple(sigmas),
        burn_limits=tuple(on_burns),
        drifts=tuple(drifts),
        lost_contacts=tuple(lost_contacts(mission, burns, policy)) or None,
        wider=wider_than_law(ends, stored[-1]) or None,
        ok=not failed,
    )


def limits_of(mission: Mission) -> dict[str, float]:
    """Limits of a verification, by the figures' names, in their units.

    If too few burns are left to meet the final state, its miss is reported but not judged:
    infinity.
    """
    missed, tolerance = not mission.must_meet, mission.units.tolerance
    final = tolerance(POSITION_LIMIT_M, "m"), tolerance(VELOCITY_LIMIT_M_S, "m/s")
    return {
        "terminal_position_error_m": np.inf if missed else final[0],
        "terminal_velocity_error_m_s": np.inf if missed else final[1],
        "max_defect": tolerance(DEFECT_LIMIT_M, "m"),
        "sample_error_m": tolerance(DEFECT_LIMIT_M, "m"),
        "covariance_error": COVARIANCE_LIMIT,
        "knowledge_error": COVARIANCE_LIMIT,
        "drift_error_m": tolerance(POSITION_LIMIT_M, "m"),
    }


def not_executed(mission: Mission, solution: Solution) -> list[str]:
    """Names of burns that the plan needs, and that are smaller than the smallest that is executed.

    A corrected burn has the root mean square of its commanded sizes. A burn of rounding's size moves
    the flight by less than its tolerances: the plan is the same without it.
    """
    sizes = np.linalg.norm(solution.burns_m_s, axis=1)
    if solution.policy is not None and not is_strange(mission, solution.policy):
        for one, stored in zip(solution.corrections, solution.policy.corrections, strict=True):
            sizes[one.burn] = np.hypot(sizes[one.burn], stored.sigma_m_s)
    least, first = mission.scenario.burns.dv_min_m_s, 1 + mission.scenario.burns_flown
    none = mission.units.tolerance(NO_BURN_M_S, "m/s")
    small = (sizes > none) & (sizes < (1.0 - EXECUTED) * least)
    return [f"dv_min of burn {first + i}" for i in np.flatnonzero(small)]


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
    """A re-integrated flight, after the burns: times (n,), states (n, 6), covariances (n, 6, 6).

    Covariances are those of the deviation from the plan, of the p parameters with it, (n, 6, p), and of
    the estimate's error; last the spread at the end.
    """

    times: Array
    states: Array
    covariances: Array
    parameters: Array
    knowledge: Array
    end: JointCovariance


def _fly(
    mission: Mission,
    burns: Array,
    times: Array,
    initial: Array,
    policy: Policy = (),
    *,
    spreads: bool = True,
) -> _Flown:
    """Fly from burn to burn and cut-off to cut-off, so that the integrator never steps over a jump.

    The flight starts from a state before the burns. Unless it `spreads`, it has no covariances.
    """
    firing = mission.scenario.burn_times_s
    stops = sorted({mission.scenario.start_s, *firing, *(one.cut_off_s for one in policy)})
    numbers = {time: number for number, time in enumerate(firing)}
    times = np.union1d(times, stops)
    states = np.full((len(times), 6), DIVERGED)  # for what the integrator does not reach
    size = 6 + mission.uncertain.count
    deviation, error = (np.full((len(times), size, size), DIVERGED) for _ in range(2))

    def flown() -> _Flown:
        own, known = deviation[:, :6, :6], error[:, :6, :6]
        return _Flown(times, states, own, deviation[:, :6, 6:], known, spread)

    state, spread = initial.copy(), JointCovariance.before_burns(mission, policy)
    for i, begin in enumerate(stops):
        spread = spread.measured(begin)
        if begin in numbers:
            state[3:] += burns[numbers[begin]]
            spread = spread.after_burn(burns[numbers[begin]], numbers[begin])
        if i + 1 == len(stops):
            break
        # The leg's last time is overwritten by the next leg's first, after burn and measurement.
        leg = (times >= begin) & (times <= stops[i + 1])
        span = begin, stops[i + 1]
        answer = integrated(mission, state, span, with_stm=spreads, t_eval=times[leg])
        if not answer.success:
            return flown()
        states[leg] = answer.y[:6].T
        state = states[leg][-1].copy()
        if not spreads:
            continue
        stm = full_stm(answer.y[6:].T)
        deviation[leg] = stm @ spread.deviation @ stm.transpose(0, 2, 1)
        error[leg] = stm @ spread.error @ stm.transpose(0, 2, 1)
        spread = spread.carried(stm[-1])
    states[-1], deviation[-1], error[-1] = state, spread.deviation, spread.error
    return flown()


def integrated(
    mission: Mission,
    state: Array,
    span: tuple[float, float],
    *,
    with_stm: bool = True,
    **at: Any,
) -> Any:
    """SciPy's answer for the state and the flattened STM, shape (42 + 6 p,), from one time to another.

    The STM's last p columns are by the uncertain parameters. Without the STM it is the state's alone.
    `at` are the output times, as in `solve_ivp`.
    """
    p, partials, forces = mission.uncertain.count, mission.partials, mission.forces

    def state_rate(t: float, y: Array) -> Array:
        return np.array([*y[3:], *acceleration(y[0], y[1], y[2], forces, forces.moment(t))])

    def rate(t: float, y: Array) -> Array:
        at = y[None, :3], np.array([t])
        push = None if partials is None else partials.accelerations(*at)[0]
        return variational_rate(y, forces, forces.moment(t), push)

    stm = np.eye(6, 6 + p).ravel() if with_stm else np.empty(0)
    return solve_ivp(
        rate if with_stm else state_rate,
        span,
        np.concatenate([state, stm]),
        method="DOP853",
        rtol=1e-12,
        atol=1e-13 * np.concatenate([mission.units.state, np.ones(len(stm))]),
        **at,
    )


def full_stm(flat: Array) -> Array:
    """STMs of state and parameters (..., 6 + p, 6 + p), from flattened ones (..., 36 + 6 p)."""
    rows = flat.reshape(*flat.shape[:-1], 6, -1)
    size = rows.shape[-1]
    below = np.broadcast_to(np.eye(size)[6:], (*rows.shape[:-2], size - 6, size))
    return np.concatenate([rows, below], axis=-2)


def variational_rate(
    y: Array, forces: ForceModel, moment: Moment | None = None, push: Array | None = None
) -> Array:
    """d/dt of the state and the flattened STM, shape (42 + 6 p,).

    `push` are derivatives of the acceleration by p parameters, shape (3, p).

    The gravity gradient is a complex step of the acceleration: exact to roundoff and independent of
    the closed forms that the planner uses.
    """
    step = 1e-20
    r = y[:3, None] + 1j * step * np.eye(3)
    columns = np.stack(acceleration(r[0], r[1], r[2], forces, moment))
    stm = y[6:].reshape(6, -1)
    stm_rate = np.concatenate([stm[3:], columns.imag / step @ stm[:3]])
    if push is not None:
        stm_rate[3:, 6:] += push
    return np.concatenate([y[3:6], columns.real[:, 0], stm_rate.ravel()])


def _sample_error(mission: Mission, burns: Array, policy: Policy) -> float:
    """Largest difference of some sampled flights from the adaptive integration of the same, m."""
    times = mission.times_s[[0, *mission.window_nodes, -1]]
    sampled = Flyer(mission, burns, policy).fly_block(times, 0, flights=FLIGHTS_CHECKED, seed=SEED)
    errors = []
    for i, executed in enumerate(sampled.burns_m_s):
        initial = sampled.states[0, i].copy()
        if not mission.problem.coasts:
            initial[3:] -= executed[0]
        own = sampled.mission.some_flights(i)
        again = _fly(own, executed, times, initial, spreads=False)
        looked = np.searchsorted(again.times, times)
        errors.append(np.abs(again.states[looked] - sampled.states[:, i]) / mission.units.state)
    return _finite(np.max(errors) * mission.units.length_m)


def _drift_error(mission: Mission, states: Array, burns: Array) -> float:
    """Largest distance of the means of planned drifts from the adaptive integration of the same, m.

    Both begin at the stored states (n, 6) of the burns' nodes, less the shares of burns that lack.
    """
    errors, units = [], mission.units.state
    for miss, one in zip(planned_misses(mission.scenario), mission.problem.drifts, strict=True):
        start, times = (
            states[mission.burn_nodes[one.burn]].copy(),
            drift_times(mission.scenario, miss),
        )
        start[3:] -= (1.0 - one.share) * burns[one.burn]
        with np.errstate(all="ignore"):  # a drift through the body may end anywhere
            mean = Dynamics(one.flow, np.zeros(0, np.intp)).rollout(start / units, np.zeros((0, 3)))
            again = integrated(mission, start, (times[0], times[-1]), t_eval=times)
            if not again.success:
                return DIVERGED
            errors.append(np.abs(again.y[:3].T - mean[:, :3] * units[:3]).max())
    return _finite(np.max(errors))


def _finite(figure: np.floating) -> float:
    return float(np.nan_to_num(figure, nan=DIVERGED, posinf=DIVERGED))


def _covariance_error(mission: Mission, stored: Array, flown: Array) -> float:
    """Largest error of a node's covariance relative to its largest entry, in scaled units."""
    units = np.outer(mission.units.state, mission.units.state)
    return relative_error(stored / units, flown / units)


def _parameter_error(mission: Mission, solution: Solution, flown: Array) -> float:
    """Largest error of a node's covariance of state and parameters, in standard deviations."""
    given, units = np.array(solution.nodes.parameters), mission.units.state[:, None]
    if given.shape != flown.shape:
        return DIVERGED
    size = np.abs(flown / units).max(axis=(1, 2))
    error = np.abs((given - flown) / units).max(axis=(1, 2))
    return _finite((error / np.maximum(size, SMALLEST)).max())


def _knowledge_error(mission: Mission, solution: Solution, flown: _Flown, nodes: Indices) -> float:
    """Largest error of estimates' covariances at nodes, and at cut-offs before and after measuring."""
    stored = solution.policy
    assert stored is not None
    if solution.nodes.knowledge is None or len(flown.end.known) != len(stored.corrections):
        return DIVERGED
    given = [[c.predicted_covariance for c in stored.corrections]]
    given += [[c.estimate_covariance for c in stored.corrections]]
    exact = [
        [known.before for known in flown.end.known],
        [known.after for known in flown.end.known],
    ]
    if np.shape(given) != np.shape(exact):
        return DIVERGED
    at_nodes = _covariance_error(
        mission, np.array(solution.nodes.knowledge), flown.knowledge[nodes]
    )
    return max(at_nodes, *_estimate_errors(mission, np.concatenate(given), np.concatenate(exact)))


def _estimate_errors(mission: Mission, given: Array, exact: Array) -> Iterator[float]:
    """Errors of covariances (n, 6 + q, 6 + q): of the state, of parameters with it, and of these."""
    yield _covariance_error(mission, given[:, :6, :6], exact[:, :6, :6])
    if given.shape[1] > 6:
        units = mission.units.state
        yield relative_error(given[:, 6:, :6] / units, exact[:, 6:, :6] / units)
        yield relative_error(given[:, 6:, 6:], exact[:, 6:, 6:])


def relative_error(given: Array, exact: Array) -> float:
    """Largest error of nondimensional covariances (n, ., .), relative to each one's largest entry."""
    size = np.abs(exact).max(axis=(1, 2))
    error = np.abs(given - exact).max(axis=(1, 2))
    return _finite((error / np.maximum(size, SMALLEST)).max())


def _mean_margins(mission: Mission, flown: _Flown) -> list[MeanMargin]:
    """Margins of every original constraint, between the nodes too."""
    first, last = mission.observed_s or (np.inf, np.inf)
    window = (flown.times >= first) & (flown.times <= last)
    times = flown.times[window]
    margins = observation_margins(mission, times, flown.states[window, :3])
    clear = safety_margins(mission.scene, flown.times, flown.states[:, :3])
    observed = margins.items() if len(times) else ()
    seen = [_worst(name, unit, times, margin) for name, (unit, margin) in observed]
    return [*(_worst(name, "m", flown.times, margin) for name, margin in clear.items()), *seen]


def _burn_margins(mission: Mission, burns: Array) -> list[MeanMargin]:
    """Size of the planned burns and their angle from the Sun line, either way."""
    times = np.array(mission.scenario.burn_times_s)
    size = np.linalg.norm(burns, axis=1)
    angle = geometry.angle(burns, mission.sun_direction(times))
    cone = np.deg2rad(mission.scenario.battery.delta_v_cone_deg)
    none = mission.units.tolerance(NO_BURN_M_S, "m/s")
    off_sun = np.where(size > none, np.minimum(angle, np.pi - angle) - cone, np.inf)
    margins = [_worst("dv_max", "m/s", times, mission.scenario.burns.dv_max_m_s - size)]
    if np.isfinite(off_sun).any():
        margins.append(_worst("dv_battery", "rad", times, off_sun))
    return margins


def _worst(name: str, unit: Literal["m", "rad", "m/s"], times: Array, margin: Array) -> MeanMargin:
    at = int(np.argmin(margin))
    return MeanMargin(name, float(margin[at]), unit, float(times[at]))
