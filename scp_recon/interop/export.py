"""Prepare a plan for export: fly its path again, and head every file with scenario, verdict and units.

Velocity jumps at a burn, so the path is a sequence of coasts: one before the first burn, one from each
burn to the next, one after the last. Neighbouring coasts share a time and a position. The first and the
last coast, ten minutes each, are not planned; they give the states on both sides of the outer burns.

The integration is that of the verification: the planner's acceleration by DOP853 at a relative
tolerance of 1e-12, and the STM by its variational equations. Straight lines between sampled states
are within a centimetre of the flight, at the default mission's scale. Cubics are closer by orders of
magnitude.
"""

from __future__ import annotations

import textwrap
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.integrate import OdeSolution

from formulations.arrays import Array
from scp_recon.display import digits
from scp_recon.errors import InputError, printable, version_of
from scp_recon.mission.constraints import check_miss
from scp_recon.mission.mission import Mission
from scp_recon.monte_carlo.drifts import reach_s
from scp_recon.monte_carlo.summary import missed_by_law
from scp_recon.physics.flow import interpolate
from scp_recon.results.facts import Burn
from scp_recon.results.solution import Solution
from scp_recon.scenario.time_scales import instant, iso_tdb, iso_utc
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


def fly_coasts(solution: Solution, miss: int | None = None) -> tuple[Coast, ...]:
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
    _check(coasts, mission, solution, firing[-1 if miss is None else executed])
    return tuple(coasts)


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


def _check(coasts: Sequence[Coast], mission: Mission, solution: Solution, until_s: float) -> None:
    """Compare the flown path with the nodes that are stored until a time."""
    nodes, stored = np.array(solution.nodes.t_s), np.array(solution.nodes.state)
    nodes, stored = nodes[nodes <= until_s], stored[nodes <= until_s]
    times = np.concatenate([coast.times_s for coast in coasts])
    states = np.concatenate([coast.states for coast in coasts])
    flown = states[np.searchsorted(times, nodes, side="right") - 1]  # after the burn
    off = float(np.linalg.norm(flown[:, :3] - stored[:, :3], axis=1).max())
    limit = limits_of(mission)["max_defect"]
    if not off <= limit:
        raise InputError(
            "solution",
            f"nodes up to {digits(off, 3)} m off the path that its burns give",
            f"must be within {limit:g} m of it",
        )


SPACECRAFT_ID = -999
"""Default number of the spacecraft; NAIF's are negative, and this one is not assigned."""
UNNAMED_BODY_ID = 9_999_999
"""Number of a body whose scenario has no `body.naif_id`."""
LINE = 100


@dataclass(frozen=True, eq=False)
class Export:
    """A plan to be exported: its solution and the coasts between its burns.

    Attributes:
        solution: the plan's solution.
        coasts: before burn 1, after burn 1, ..., after the last, sampled as closely as lines need.
        spacecraft: NAIF's number in the files, below zero.
        miss: number of the burn that is missed, whose drift the path is; None for the whole plan.
    """

    solution: Solution
    coasts: tuple[Coast, ...]
    spacecraft: int = SPACECRAFT_ID
    miss: int | None = None

    @classmethod
    def of(
        cls, solution: Solution, spacecraft: int = SPACECRAFT_ID, miss: int | None = None
    ) -> Export:
        """Fly a plan's burns again, sampled for other tools.

        Raises:
            InputError: as `fly_coasts`, or if there is no such burn to miss.
        """
        check_miss(solution.scenario, miss)
        return cls(solution, fly_coasts(solution, miss), spacecraft, miss)

    @property
    def mission(self) -> Mission:
        """Mission of the solution."""
        return self.solution.mission

    @property
    def linear_error_m(self) -> float:
        """Largest distance from the flight of straight lines between neighbours."""
        return max(coast.linear_error_m for coast in self.coasts)

    @property
    def cubic_error_m(self) -> float:
        """Largest distance from the flight of cubics between neighbours."""
        return max(coast.cubic_error_m for coast in self.coasts)

    @property
    def within_m(self) -> float:
        """`WITHIN_M` at the mission's scale."""
        return self.mission.units.tolerance(WITHIN_M, "m")

    @property
    def size(self) -> int:
        """Number of states, two at a burn."""
        return sum(len(coast.times_s) for coast in self.coasts)

    @property
    def body(self) -> int:
        """NAIF's number of the body in the files."""
        return self.mission.scenario.body.naif_id or UNNAMED_BODY_ID

    @property
    def burns_flown(self) -> int:
        """Number of burns flown before a plan made in flight."""
        return self.mission.scenario.burns_flown

    @property
    def executed(self) -> list[tuple[int, Burn]]:
        """Burns along the path that have a size, with their numbers in the flight."""
        some = self.solution.executed
        return [(number, burn) for number, burn in some if not self.miss or number < self.miss]

    @property
    def shortfalls(self) -> list[str]:
        """Reasons for which the plan is not verified; empty if it is."""
        checked = self.solution.verification
        if checked is None:
            return [f"{self.solution.status}, and never checked"]
        if not checked.ok:
            return [f"{self.solution.status}; failed: {checked.failed_in_words}"]
        return []

    @property
    def verdict(self) -> str:
        """The verdict in one line."""
        return "; ".join(f"NOT VERIFIED: {why}" for why in self.shortfalls) or "verified"

    def instant(self, time_s: float) -> int:
        """Nanoseconds of TDB past J2000 at a time in s past the scenario's epoch."""
        return instant(self.mission.scenario.epoch.tdb, time_s)

    def et(self, times_s: np.ndarray) -> np.ndarray:
        """SPICE's ephemeris time (TDB seconds past J2000) of times in s past the scenario's epoch."""
        return self.instant(0.0) / 1e9 + times_s


def maker() -> str:
    """Name and version of this program."""
    return f"scp_recon {version_of('scp_recon')}"


def heading(export: Export) -> list[str]:
    """Lines of the heading, in ASCII, short enough for a CCSDS message."""
    scenario, solution = export.mission.scenario, export.solution
    total = sum(float(np.linalg.norm(burn.dv_m_s)) for _, burn in export.executed)
    policy, checked = solution.policy, solution.verification
    missed = missed_by_law(checked.wider or {}) if checked else None
    lines = [
        f"scenario {scenario.name}, {solution.problem}, by {maker()}",
        f"plan {solution.plan_hash}",
        f"{export.verdict}",
        *(f"warning: {warning}" for warning in solution.warnings),
        f"center {scenario.body.name} (NAIF {export.body}), spacecraft NAIF "
        f"{export.spacecraft}; axes J2000, which are the ICRF's, inertial",
        f"t_s = 0 is {iso_tdb(export.instant(0.0))} TDB, {iso_utc(export.instant(0.0))} UTC",
        f"mean and covariance of the planner's model; coasting {MARGIN_S:g} s before the first burn "
        "and after the last is not part of the plan",
        *([f"of this covariance: {missed}"] if missed else []),
        f"a straight line between neighbouring states is within {export.linear_error_m:.1e} m of the "
        f"flight (required: {export.within_m:g}), a cubic of both states within "
        f"{export.cubic_error_m:.1e} m",
        f"{len(export.executed)} burns, impulses; {total:.6f} m/s in all:",
        *(burn_line(export, number) for number in range(1, len(solution.burns) + 1)),
        *(
            f"burn {one.burn} is corrected in flight, from a measurement at t_s = {one.cut_off_s:g}; "
            f"1 sigma of the correction is {one.sigma_m_s:.6f} m/s"
            for one in (policy.corrections if policy else ())
        ),
        *([f"{policy}; burns are without corrections, covariances with them"] if policy else []),
    ]
    plain = [printable(line).encode("ascii", "replace").decode() for line in lines]
    return [part for line in plain for part in textwrap.wrap(line, LINE) or [""]]


def burn_line(export: Export, number: int) -> str:
    """Describe a burn, given by its number in the plan, from 1; the text counts the whole flight's."""
    burn = export.solution.burns[number - 1]
    when = export.instant(burn.t_s)
    x, y, z = burn.dv_m_s
    number, policy = export.burns_flown + number, export.solution.policy
    named, corrections = f"burn {number}", policy.corrections if policy is not None else []
    if export.miss and number >= export.miss:
        return f"{named}: missed; a free drift" if number == export.miss else f"{named}: none"
    if not any(burn.dv_m_s):
        corrected = any(one.burn == number for one in corrections)
        why = "but its correction" if corrected else "as it would be too small to execute"
        return f"{named}: none, {why}"
    return (
        f"{named}: t_s = {burn.t_s:g}, {iso_tdb(when)} TDB, {iso_utc(when)} UTC, "
        f"{x:+.9f} {y:+.9f} {z:+.9f} m/s along J2000 x, y, z"
    )
