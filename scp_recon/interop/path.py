"""Fly a plan's mean and covariance again, sampled densely enough for linear interpolation.

Velocity jumps at a burn, so the path is a sequence of coasts: one before the first burn, one from each
burn to the next, one after the last. Neighbouring coasts share a time and a position. The first and the
last coast, ten minutes each, are not planned; they give the states on both sides of the outer burns.

The integration is that of the verification: the planner's acceleration by DOP853 at a relative
tolerance of 1e-12, and the STM by its variational equations. Straight lines between sampled states
are within a centimetre of the flight, at the default mission's scale. Cubics are closer by orders of
magnitude.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.integrate import OdeSolution

from formulations.arrays import Array
from scp_recon.display import digits
from scp_recon.errors import InputError
from scp_recon.mission.mission import Mission
from scp_recon.monte_carlo.drifts import reach_s
from scp_recon.physics.flow import interpolate
from scp_recon.results.solution import Solution
from scp_recon.verification.closed_loop import JointCovariance
from scp_recon.verification.reintegration import full_stm, integrated, limits_of

WITHIN_M = 0.01
"""Largest distance of straight lines between neighbours from the flight, m, at the default mission's
scale."""
STEP_MAX_S, MARGIN_S = 60.0, 600.0
"""Longest step; and how long the coasts before the first and after the last burn are."""
STATES_MAX = 200_000
"""Largest number of states of a path: a file of a hundred megabytes."""


@dataclass(frozen=True, eq=False)
class Coast:
    """States between burns, SI, J2000, body-centred.

    Attributes:
        times_s: times past the epoch, ascending, shape (n,).
        states: mean states, shape (n, 6).
        covariances: shape (n, 6, 6).
        linear_error_m: largest distance of straight lines between neighbours from the flight.
        cubic_error_m: the same for cubics through neighbours' positions and velocities.
    """

    times_s: Array
    states: Array
    covariances: Array
    linear_error_m: float
    cubic_error_m: float

    def joined(self, other: Coast) -> Coast:
        """This coast and one that follows it without a burn."""
        return Coast(
            np.concatenate([self.times_s, other.times_s[1:]]),
            np.concatenate([self.states, other.states[1:]]),
            np.concatenate([self.covariances, other.covariances[1:]]),
            max(self.linear_error_m, other.linear_error_m),
            max(self.cubic_error_m, other.cubic_error_m),
        )


@dataclass(frozen=True, eq=False)
class FlownPath:
    """The coasts of a plan, in order: before burn 1, after burn 1, ..., after the last.

    Attributes:
        coasts: with their states, as closely spaced as interpolation needs.
        within_m: `WITHIN_M` at the mission's scale.
    """

    coasts: tuple[Coast, ...]
    within_m: float

    @property
    def linear_error_m(self) -> float:
        """Largest distance from the flight of straight lines between neighbours."""
        return max(coast.linear_error_m for coast in self.coasts)

    @property
    def cubic_error_m(self) -> float:
        """Largest distance from the flight of cubics between neighbours."""
        return max(coast.cubic_error_m for coast in self.coasts)

    @property
    def size(self) -> int:
        """Number of states, two at a burn."""
        return sum(len(coast.times_s) for coast in self.coasts)


def fly_path(solution: Solution, miss: int | None = None) -> FlownPath:
    """Fly a plan's burns and sample the path; if a burn is missed, the free drift from it on.

    Raises:
        InputError: if the stored nodes are off the path, or the path needs too many states.
    """
    mission = solution.mission
    nodes, firing = np.array(solution.nodes.t_s), [burn.t_s for burn in solution.burns]
    begin, state = float(nodes[0]), mission.initial_state.copy()
    spread = JointCovariance.before_burns(mission, solution.corrections).measured(begin)
    back = _flight(mission, state, begin, begin - MARGIN_S)
    within = mission.units.tolerance(WITHIN_M, "m")
    coasts = [_sampled(back, np.array([begin - MARGIN_S, begin]), spread.deviation, within)]
    # Each time at which a coast ends, and the burn there; the first may begin with one.
    executed = len(firing) if miss is None else miss - 1 - mission.scenario.burns_flown
    last = firing[-1] + MARGIN_S if miss is None else firing[executed] + reach_s(mission)
    burns = solution.burns_m_s[:executed]
    ends = [*zip(firing[:executed], burns, strict=True), (last, None)]
    for end, burn in ends:
        if end > begin:
            flown = _flight(mission, state, begin, end)
            edges = np.array([begin, *nodes[(nodes > begin) & (nodes < end)], end])
            coast = _sampled(flown, edges, spread.deviation, within)
            if begin == nodes[0] and firing[0] > begin:  # it coasts before its first burn
                coasts = [coasts[0].joined(coast)]
            else:
                coasts.append(coast)
            state, spread = flown(end)[:6], _carried(spread, flown, begin, end)
        if burn is not None:
            state[3:] += burn
            begin, spread = end, spread.after_burn(burn, firing.index(end))
    path = FlownPath(tuple(coasts), within)
    _check(path, mission, solution, firing[-1 if miss is None else executed])
    return path


def _carried(
    spread: JointCovariance, flown: OdeSolution, begin: float, end: float
) -> JointCovariance:
    """Carry the spread to the end of a coast, with all measurements up to and at its end."""
    stm, cut_offs = np.eye(spread.size), [one.cut_off_s for one in spread.policy]
    for time in [*(cut_off for cut_off in cut_offs if begin < cut_off < end), end]:
        there = full_stm(flown(time)[6:])
        spread = spread.carried(np.asarray(there @ np.linalg.inv(stm))).measured(time)
        stm = there
    return spread


def _flight(mission: Mission, state: Array, begin: float, end: float) -> OdeSolution:
    """State and STM from one time to a later or earlier one, shape (42,), as a function of time."""
    flown = integrated(mission, state, (begin, end), dense_output=True)
    if not flown.success:
        raise InputError("solution", "a path that falls into the body", "must be one that flies on")
    sol: OdeSolution = flown.sol
    return sol


def _sampled(flown: OdeSolution, edges: Array, covariance: Array, within_m: float) -> Coast:
    """Sample each arc between edges evenly, with steps small enough for straight lines."""
    ascending = np.sort(edges)
    step = STEP_MAX_S
    while True:
        pieces = np.maximum(np.ceil(np.diff(ascending) / step - 1e-9), 1.0).astype(int)
        if pieces.sum() > STATES_MAX:
            raise InputError(
                "solution",
                f"a path of more than {STATES_MAX} states {step:.2g} s apart",
                f"must be one that straight lines of so many follow within {within_m:g} m",
            )
        times = np.concatenate(
            [
                np.linspace(a, b, n, endpoint=False)
                for a, b, n in zip(ascending[:-1], ascending[1:], pieces, strict=True)
            ]
            + [ascending[-1:]]
        )
        linear, cubic = _errors_m(flown, times)
        if linear <= within_m:
            break
        step *= 0.9 * float(np.sqrt(within_m / linear))
    y = flown(times).T
    stm = full_stm(y[:, 6:])
    spread = stm @ covariance @ stm.transpose(0, 2, 1)
    return Coast(times, y[:, :6], spread[:, :6, :6], linear, cubic)


def _errors_m(flown: OdeSolution, times: Array) -> tuple[float, float]:
    """Errors of a line and a cubic half-way between neighbours, where both are largest."""
    at, middle = flown(times)[:6].T, flown(0.5 * (times[:-1] + times[1:]))[:3].T
    start, end = at[:-1], at[1:]
    line = 0.5 * (start[:, :3] + end[:, :3])
    cubic, _ = interpolate(
        (start[:, :3], start[:, 3:]), (end[:, :3], end[:, 3:]), np.diff(times)[:, None], 0.5
    )
    off = [np.linalg.norm(found - middle, axis=1).max() for found in (line, cubic)]
    return float(off[0]), float(off[1])


def _check(path: FlownPath, mission: Mission, solution: Solution, until_s: float) -> None:
    """Compare the flown path with the nodes that are stored until a time."""
    nodes, stored = np.array(solution.nodes.t_s), np.array(solution.nodes.state)
    nodes, stored = nodes[nodes <= until_s], stored[nodes <= until_s]
    times = np.concatenate([coast.times_s for coast in path.coasts])
    states = np.concatenate([coast.states for coast in path.coasts])
    flown = states[np.searchsorted(times, nodes, side="right") - 1]  # after the burn
    off = float(np.linalg.norm(flown[:, :3] - stored[:, :3], axis=1).max())
    limit = limits_of(mission)["max_defect"]
    if not off <= limit:
        raise InputError(
            "solution",
            f"nodes up to {digits(off, 3)} m off the path that its burns give",
            f"must be within {limit:g} m of it",
        )
