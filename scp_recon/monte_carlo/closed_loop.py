"""Command the burns of flights under way, corrected by gains or planned again, from estimates.

The policy "replan" plans again before each burn. At a cut-off the state is measured. A Kalman filter
with the covariances of the planned flight estimates it. Uncertain parameters are considered, at each
cut-off as independent of the estimate before. The rest of the flight is planned again from the
estimate, near the plan from the planned state. Each cut-off has one program, compiled once. If a
replan does not converge, the flight keeps its last burns. Between cut-offs estimates follow the
planner's dynamics and the commanded burns.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from formulations.arrays import Array, Booleans
from scp_recon.errors import InputError, option
from scp_recon.mission.feedback import data_until_s, require_measurement
from scp_recon.mission.mission import Mission
from scp_recon.mission.schedule import BURNS_TO_MEET
from scp_recon.physics.flow import propagate
from scp_recon.planning.initial_guess import from_burns
from scp_recon.results.policy import CutOff, Policy, transition
from scp_recon.scenario.schema import Scenario

MEASURED = 6
"""Standard normal numbers that a measurement draws."""

LEAST_LEAD_S = 1.0
"""Time from a measurement to the burn planned from it, where navigation has no lead at all."""


def due(policy: Sequence[CutOff], after_s: float, until_s: float) -> Iterator[float]:
    """The cut-offs of a policy after one time and up to another."""
    for one in policy:
        if after_s < one.cut_off_s <= until_s:
            yield one.cut_off_s


class ClosedLoop:
    """Measurements and corrections of flights under way; J2000, m and m/s.

    Args:
        mission: that is flown.
        burns_m_s: planned, shape (m, 3).
        policy: that corrects them.
        draws: standard normal numbers of the measurements, shape (flights, 6 k).

    Attributes:
        failed: empty: corrections cannot fail.
    """

    failed: Sequence[Booleans] = ()

    def __init__(self, mission: Mission, burns_m_s: Array, policy: Policy, draws: Array) -> None:
        self._policy = policy
        self._draws = draws.reshape(len(draws), len(policy), MEASURED)
        self._measured: list[Array] = []  # deviations from the plan at the cut-offs, (6, flights)
        self._planned, self._commands = (
            _commands(mission, burns_m_s, policy) if policy else ([], [])
        )

    def measure(self, state: Array) -> None:
        """Measure true states (6, flights) at the next cut-off, before a burn there."""
        j = len(self._measured)
        noise = self._policy[j].noise(self._draws[:, j])
        self._measured.append(state - self._planned[j][:, None] + noise)

    def correction(self, burn: int) -> Array | None:
        """Correction of a planned burn, shape (flights, 3); None if it has no gains."""
        for j, one in enumerate(self._policy):
            if one.burn == burn and one.gains.any():
                measured = np.concatenate(self._measured[: j + 1])
                return np.asarray((self._commands[j][:, : len(measured)] @ measured).T)
        return None


def _commands(
    mission: Mission, burns_m_s: Array, policy: Policy
) -> tuple[list[Array], list[Array]]:
    """Planned states before the burn at each cut-off, and the corrections as a linear map.

    Each correction is a matrix (3, 6 k) times the measured deviations at all k cut-offs; those after
    its own have no part. Estimates are predicted by the plan's transition matrices and the corrections.
    """
    iterate, size = from_burns(mission, burns_m_s), len(policy[0].estimate_covariance)
    lin = mission.dynamics.linearise(mission.problem.open_loop, iterate)
    units, count = mission.state_units(size), MEASURED * len(policy)
    stm = units[:, None] * lin.stm_of_arcs[:, :size, :size] / units
    states, estimates, commands = list[Array](), list[Array](), list[Array]()
    nodes = [int(np.searchsorted(mission.times_s, one.cut_off_s)) for one in policy]
    for j, (one, node) in enumerate(zip(policy, nodes, strict=True)):
        state = iterate.mean[node] * mission.units.state
        state[3:] -= burns_m_s[mission.burn_nodes == node].sum(axis=0)
        states.append(state)
        estimate = np.zeros((size, count))
        if estimates:
            estimate += transition(stm, nodes[j - 1], node) @ estimates[-1]
        for earlier, command in zip(policy, commands, strict=False):
            fired = int(mission.burn_nodes[earlier.burn])
            if nodes[j - 1] <= fired < node:
                estimate += transition(stm, fired, node)[:, 3:6] @ command
        innovation = np.eye(MEASURED, count, MEASURED * j) - estimate[:MEASURED]
        estimates.append(estimate + one.kalman_gain @ innovation)
        gained = zip(one.gains, estimates, strict=True)
        commands.append(np.sum([gain @ known[:MEASURED] for gain, known in gained], axis=0))
    return states, commands


@dataclass(frozen=True, eq=False)
class Replan(CutOff):
    """Planning again before one burn.

    Attributes:
        mission: the rest of the flight from the planned state, with the estimate's covariance.
        burns_m_s: planned for it, shape (m, 3).
    """

    mission: Mission
    burns_m_s: Array


Replans = tuple[Replan, ...]
"""Plans of the rest of flights, in the order of their cut-offs and burns."""


def cut_offs_s(scenario: Scenario) -> dict[int, float]:
    """Times at which a flight is planned again, s, by the number of the burn, from 0.

    Raises:
        InputError: if nothing is measured, no burn has a cut-off in flight, or a cut-off precedes the
            burn before.
    """
    require_measurement(scenario, option("policy"), "'replan'")
    firing = scenario.burn_times_s
    until = (min(data_until_s(scenario, i, t), t - LEAST_LEAD_S) for i, t in enumerate(firing))
    cut_offs = {i: at for i, at in enumerate(until) if at > scenario.start_s}
    early = [i for i, at in cut_offs.items() if i > 0 and at <= firing[i - 1]]
    if not cut_offs or early:
        burn = scenario.burns_flown + 1 + (early[0] if early else len(firing) - 1)
        lead = scenario.navigation.lead_s
        entry, given, needs = "navigation.lead_s", f"{max(lead, LEAST_LEAD_S):g} s", "less"
        if scenario.navigation.contacts is not None:
            entry, given, needs = "navigation.contacts", "contacts", "more frequent"
        elif (landmarks := scenario.navigation.landmarks) is not None:
            entry, given = "navigation.landmarks.every_s", f"{landmarks.every_s:g} s"
        raise InputError(
            entry,
            f"{given}, with which the cut-off of burn {burn} precedes the one before",
            f"must be {needs} for {option('policy')} 'replan'",
        )
    return cut_offs


def replans(mission: Mission, burns_m_s: Array) -> Replans:
    """Planning again before every burn of a plan whose cut-off is after its beginning.

    Raises:
        InputError: as `cut_offs_s`.
    """
    scenario = mission.scenario
    cut_offs = cut_offs_s(scenario)
    nodes = sorted({*scenario.grid.nodes_s, *cut_offs.values()})
    left, burns = Mission.from_scenario(scenario.replace({"grid.nodes_s": nodes})), burns_m_s
    found, pictured = list[Replan](), scenario.navigation.landmarks is not None
    if pictured:
        roots = left.along(burns).measured_by_pictures(np.array(list(cut_offs.values())))
    for burn, at_s in cut_offs.items():
        lin = left.dynamics.linearise(left.problem.open_loop, from_burns(left, burns))
        node = int(np.searchsorted(left.times_s, at_s))
        state = lin.iterate.mean[node] * left.units.state
        factor = lin.factor[node] * left.units.state[:, None]
        root = roots[len(found)] if pictured else left.scene.measurement_factor
        measured, before = root @ root.T, factor @ factor.T
        after = before - before @ np.linalg.solve(before + measured, before)
        flown = [] if scenario.in_flight is None else list(scenario.in_flight.flown_m_s)
        delivered = {
            "at_s": at_s,
            "position_m": state[:3].tolist(),
            "velocity_m_s": state[3:].tolist(),
            "covariance": (0.5 * (after + after.T)).tolist(),
            "flown_m_s": [*flown, *burns_m_s[:burn].tolist()],
        }
        scenario_left = left.scenario.replace({"in_flight": None}).replace({"in_flight": delivered})
        left, burns = Mission.from_scenario(scenario_left, known=left), burns_m_s[burn:]
        found.append(Replan(burn, at_s, measured, after, left, burns))
    return tuple(found)


class ReplanLoop:
    """Estimates and burns of flights under way; J2000, m and m/s.

    Args:
        mission: that is flown.
        burns_m_s: planned, shape (m, 3).
        policy: where they are planned again.
        draws: standard normal numbers of the measurements, shape (flights, 6 k).

    Attributes:
        failed: flights whose replan did not converge, at each cut-off so far, (flights,) each.
    """

    def __init__(self, mission: Mission, burns_m_s: Array, policy: Replans, draws: Array) -> None:
        self._mission, self._planned, self._policy = mission, burns_m_s, policy
        self._draws = draws.reshape(len(draws), len(policy), MEASURED)
        self._burns = np.tile(burns_m_s, (len(draws), 1, 1))
        self._estimates = np.tile(mission.initial_state, (len(draws), 1))
        self._now = mission.scenario.start_s
        self.failed: list[Booleans] = []

    def measure(self, state: Array) -> None:
        """Update the estimates at the next cut-off from true states (6, flights), and plan again."""
        j = len(self.failed)
        one = self._policy[j]
        self._carry(one.cut_off_s)
        innovation = state + one.noise(self._draws[:, j]) - self._estimates.T
        self._estimates += (one.kalman_gain @ innovation).T
        found = _plan_again(one, self._estimates)
        self.failed.append(np.isnan(found[:, 0, 0]))
        kept = ~self.failed[-1]
        self._burns[kept, one.burn :] = found[kept]

    def correction(self, burn: int) -> Array | None:
        """Commanded less planned burn, shape (flights, 3); None before any replan."""
        if not self.failed or burn < self._policy[0].burn:
            return None
        return np.asarray(self._burns[:, burn] - self._planned[burn])

    def _carry(self, until_s: float) -> None:
        """Propagate the estimates through the commanded burns."""
        firing = self._mission.scenario.burn_times_s
        for burn, time in enumerate((*firing, np.inf)):
            if time < self._now:
                continue
            stop = min(time, until_s)
            if stop > self._now:
                steps = int(np.ceil((stop - self._now) / self._mission.flight_step_s))
                took = np.full(len(self._estimates), stop - self._now)
                forces, begin = self._mission.forces, self._now
                self._estimates = propagate(self._estimates, took, forces, steps, begin)
                self._now = stop
            if time >= until_s:
                return
            self._estimates[:, 3:] += self._burns[:, burn]


def _plan_again(one: Replan, states: Array) -> Array:
    """Burns from estimated states (flights, 6), shape (flights, m, 3); NaN where none were found."""
    from scp_recon.planning.method import SETTLE
    from scp_recon.planning.planner import Planner  # CVXPY takes a second to import
    from scp_recon.scp.status import Status

    found = np.full((len(states), *one.burns_m_s.shape), np.nan)
    planner = Planner(one.mission)
    determined = len(one.burns_m_s) <= BURNS_TO_MEET  # by the final state
    first = planner.plan(
        from_burns(one.mission, one.burns_m_s),
        facet_rounds=0 if determined else SETTLE,
        once=determined,
    )
    if first.final.problem != "P2":
        return found
    for row, state in zip(found, states, strict=True):
        try:
            plan = planner.replan(first, state)
        except ValueError:  # the estimate is inside the body
            continue
        if plan.status is Status.CONVERGED:
            row[:] = plan.burns_m_s
    return found
