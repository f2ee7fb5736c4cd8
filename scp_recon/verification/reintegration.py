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

from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
import numpy.typing as npt
from scipy.integrate import solve_ivp

from formulations.arrays import Array
from formulations.linearisation.dynamics import Dynamics
from scp_recon.jobs.cores import beside
from scp_recon.mission.constraints import drift_times, planned_misses, safety_margins
from scp_recon.mission.mission import Mission
from scp_recon.mission.schedule import MISS_WEIGHT
from scp_recon.monte_carlo.estimates import CONFIDENCE
from scp_recon.monte_carlo.limits import MEAN_TOLERANCE, observation_margins
from scp_recon.monte_carlo.sampling import Flyer
from scp_recon.physics.forces import ForceModel, Moment, acceleration
from scp_recon.results.figures import is_converged, strange_parts
from scp_recon.results.policy import Policy
from scp_recon.results.solution import Solution
from scp_recon.results.verification import (
    BurnLimit,
    FinalMiss,
    MeanMargin,
    Verification,
)
from scp_recon.verification.closed_loop import (
    NO_BURN_M_S,
    JointCovariance,
    burn_limits,
    burn_margins,
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
EXECUTED = 1e-4
"""Share of the smallest executed burn by which a burn may be smaller: the accuracy of the solver."""
FIGURES = {
    "terminal_position_error_m": ("final position", "m", POSITION_LIMIT_M),
    "terminal_velocity_error_m_s": ("final velocity", "m/s", VELOCITY_LIMIT_M_S),
    "max_defect": ("nodes", "m", DEFECT_LIMIT_M),
    "sample_error_m": ("sampled flights", "m", DEFECT_LIMIT_M),
    "covariance_error": ("covariance, relative", "", 1e-6),
    "knowledge_error": ("covariance of estimates, relative", "", 1e-6),
    "drift_error_m": ("planned drifts", "m", POSITION_LIMIT_M),
}
"""Figures of a verification: their names in tables, units, and limits; those in m and m/s are at the
default mission's scale, as all such tolerances: see `Units.tolerance`."""
SMALLEST = 1e-30
"""Scaled covariance that counts as none."""
DIVERGED = 1e100
"""Replaces figures that are not finite: the file has no infinity, and no limit allows this number."""


def verify(mission: Mission, solution: Solution) -> Verification:
    """Check a solution against its mission; the answer holds figures and what failed."""
    burns, times = solution.burns_m_s, np.array(solution.nodes.t_s)
    states, is_p2 = np.array(solution.nodes.state), solution.problem == "P2"
    fine = np.arange(mission.times_s[0], mission.times_s[-1], MARGIN_STEP_S)
    is_strange = "policy.corrections" in strange_parts(mission, solution)
    policy = () if is_strange else solution.corrections
    with beside(lambda: joint_probabilities(mission, burns, policy)) as coming:
        flown = _fly(mission, burns, np.union1d(times, fine), mission.initial_state, policy)
        sample_error = _sample_error(mission, burns, policy)
        probabilities, ends = coming()
    at_nodes = np.searchsorted(flown.times, times)
    defects = np.abs(flown.states[at_nodes] - states) / mission.units.state * mission.units.length_m
    miss = np.abs(flown.states[-1] - mission.final_state)
    figures = {
        "terminal_position_error_m": _finite(np.linalg.norm(miss[:3])),
        "terminal_velocity_error_m_s": _finite(np.linalg.norm(miss[3:])),
        "max_defect": _finite(defects.max()),
        "sample_error_m": sample_error,
        "covariance_error": _covariance_error(mission, solution, flown.deviation[at_nodes]),
    }
    if policy:
        known = flown.error[at_nodes]
        figures["knowledge_error"] = _knowledge_error(mission, solution, known, flown.end)
    if is_p2 and mission.problem.drifts:
        figures["drift_error_m"] = _drift_error(mission, states, burns)
    limits, tolerance = limits_of(mission), mission.units.tolerance
    failed = [name for name, value in figures.items() if value > limits[name]]
    failed += inconsistencies(mission, solution)
    if not is_converged(solution):
        failed.append("status")
    margins = _mean_margins(mission, flown, burns)
    failed += [m.name for m in margins if m.worst_margin < -tolerance(MARGIN_LIMIT[m.unit], m.unit)]
    failed += not_executed(mission, solution)
    on_burns: list[BurnLimit] = []
    if policy and len(flown.end.known) == len(policy):  # else the flight has no end
        covariance = flown.end.commands
        draws = commanded(solution, covariance)
        failed += wrong_costs(mission, solution, covariance, draws)
        on_burns += burn_limits(mission, solution, draws)
        failed += [str(b) for b in on_burns if not is_kept(b, mission.scenario.risk.p_chance)]
    sigmas = flown_sigmas(mission, ends) if is_p2 else []
    if is_p2:
        failed += [*refuted(mission, solution, probabilities), *exceeded(sigmas)]
    drifts = drift_safety(mission, burns, policy, planned=is_p2)
    failed += [one.check for one in drifts if one.is_refuted]
    return Verification(
        **figures,
        mean_margins=margins,
        samples=SAMPLES,
        confidence=CONFIDENCE,
        probabilities=probabilities,
        failed=list(dict.fromkeys(failed)),
        missed=None if mission.must_meet else final_miss(mission, miss),
        final_sigmas=tuple(sigmas),
        burn_limits=tuple(on_burns),
        drifts=tuple(drifts),
        lost_contacts=tuple(lost_contacts(mission, burns, policy)) or None,
        wider=wider_than_law(ends, np.array(solution.nodes.covariance[-1])) or None,
        ok=not failed,
    )


def limits_of(mission: Mission) -> dict[str, float]:
    """Limits of a verification, by the figures' names, in their units.

    If too few burns are left to meet the final state, its miss is reported but not judged:
    infinity.
    """
    tolerance = mission.units.tolerance
    limits = {
        n: tolerance(limit, unit) if unit else limit for n, (_, unit, limit) in FIGURES.items()
    }
    if mission.must_meet:
        return limits
    return limits | dict.fromkeys(
        ("terminal_position_error_m", "terminal_velocity_error_m_s"), np.inf
    )


def not_executed(mission: Mission, solution: Solution) -> list[str]:
    """Names of burns that the plan needs, and that are smaller than the smallest that is executed.

    A corrected burn has the root mean square of its commanded sizes. A burn of rounding's size moves
    the flight by less than its tolerances: the plan is the same without it.
    """
    sizes = np.linalg.norm(solution.burns_m_s, axis=1)
    least, first = mission.scenario.burns.dv_min_m_s, 1 + mission.scenario.burns_flown
    for one in solution.policy.corrections if solution.policy is not None else ():
        sizes[one.burn - first] = np.hypot(sizes[one.burn - first], one.sigma_m_s)
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
    """A re-integrated flight, after the burns: times (n,), states (n, 6), and the spread at the end.

    Covariances of the deviation from the plan, and of the estimate's error, are those of the state
    and of p parameters, shape (n, 6 + p, 6 + p).
    """

    times: Array
    states: Array
    deviation: Array
    error: Array
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
            return _Flown(times, states, deviation, error, spread)
        states[leg] = answer.y[:6].T
        state = states[leg][-1].copy()
        if not spreads:
            continue
        stm = full_stm(answer.y[6:].T)
        deviation[leg] = stm @ spread.deviation @ stm.transpose(0, 2, 1)
        error[leg] = stm @ spread.error @ stm.transpose(0, 2, 1)
        spread = spread.carried(stm[-1])
    states[-1], deviation[-1], error[-1] = state, spread.deviation, spread.error
    return _Flown(times, states, deviation, error, spread)


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
    sampled = Flyer(mission, burns, policy, seed=SEED).fly_block(times, 0, flights=FLIGHTS_CHECKED)
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


def _covariance_error(mission: Mission, solution: Solution, exact: Array) -> float:
    """Largest error of the nodes' covariances, and of those of state and parameters."""
    units = mission.units.state[:, None]
    errors = [relative_error(solution.nodes.covariance, exact[:, :6, :6], units * units.T)]
    if mission.uncertain.count:
        errors.append(relative_error(solution.nodes.parameters, exact[:, :6, 6:], units))
    return max(errors)


def _knowledge_error(
    mission: Mission, solution: Solution, exact: Array, end: JointCovariance
) -> float:
    """Largest error of estimates' covariances at nodes, and at cut-offs before and after measuring.

    Those of cut-offs have blocks of the state, of parameters with it, and of parameters.
    """
    stored, size = solution.policy, 6 + mission.estimated
    assert stored is not None
    pairs = [(c.predicted_covariance, c.estimate_covariance) for c in stored.corrections]
    given, known = (np.array(both).reshape(-1, size, size) for both in (pairs, end.known))
    units = mission.state_units(size)[:, None] * mission.state_units(size)
    state, rest = slice(6), slice(6, None)
    blocks = (state, state), (rest, state), (rest, rest)
    errors = [relative_error(given[:, a, b], known[:, a, b], units[a, b]) for a, b in blocks]
    return max(relative_error(solution.nodes.knowledge, exact[:, :6, :6], units[:6, :6]), *errors)


def relative_error(given: npt.ArrayLike | None, exact: Array, units: Array | float = 1.0) -> float:
    """Largest error of covariances (n, ., .) in units, relative to each one's largest entry."""
    given = np.asarray(given)
    if given.shape != exact.shape:
        return DIVERGED
    size = np.abs(exact / units).max(axis=(1, 2), initial=SMALLEST)
    error = np.abs((given - exact) / units).max(axis=(1, 2), initial=0.0)
    return _finite((error / size).max())


def _mean_margins(mission: Mission, flown: _Flown, burns: Array) -> list[MeanMargin]:
    """Margins of every original constraint on burns and path, between the nodes too."""
    firing, first_last = np.array(mission.scenario.burn_times_s), mission.observed_s
    size, off_sun = burn_margins(mission, firing, burns).items()
    found = [_worst(size[0], "m/s", firing, size[1])]
    if np.isfinite(off_sun[1]).any():
        found.append(_worst(off_sun[0], "rad", firing, off_sun[1]))
    clear = safety_margins(mission.scene, flown.times, flown.states[:, :3])
    found += [_worst(name, "m", flown.times, margin) for name, margin in clear.items()]
    first, last = first_last or (np.inf, np.inf)
    window = (flown.times >= first) & (flown.times <= last)
    if window.any():
        times = flown.times[window]
        margins = observation_margins(mission, times, flown.states[window, :3])
        found += [_worst(name, unit, times, margin) for name, (unit, margin) in margins.items()]
    return found


def _worst(name: str, unit: Literal["m", "rad", "m/s"], times: Array, margin: Array) -> MeanMargin:
    at = int(np.argmin(margin))
    return MeanMargin(name, float(margin[at]), unit, float(times[at]))
