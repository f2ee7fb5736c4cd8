"""Prepare a plan for export, with the heading of every file: scenario, verdict, frame, units, time."""

from __future__ import annotations

import textwrap
from dataclasses import dataclass

import numpy as np

from scp_recon.errors import printable, version_of
from scp_recon.interop.path import MARGIN_S, FlownPath, fly_path
from scp_recon.mission.constraints import check_miss
from scp_recon.mission.mission import Mission
from scp_recon.monte_carlo.summary import missed_by_law
from scp_recon.results.facts import Burn
from scp_recon.results.solution import Solution
from scp_recon.scenario.time_scales import instant, iso_tdb, iso_utc

SPACECRAFT_ID = -999
"""Default number of the spacecraft; NAIF's are negative, and this one is not assigned."""
UNNAMED_BODY_ID = 9_999_999
"""For a body whose scenario has no `body.naif_id`."""
LINE = 100


@dataclass(frozen=True, eq=False)
class Export:
    """A plan to be exported: its solution and the path that its burns lead along.

    Attributes:
        solution: the plan's solution.
        path: flown with its burns.
        spacecraft: NAIF's number in the files, below zero.
        miss: number of the burn that is missed, whose drift the path is; None for the whole plan.
    """

    solution: Solution
    path: FlownPath
    spacecraft: int = SPACECRAFT_ID
    miss: int | None = None

    @classmethod
    def of(
        cls, solution: Solution, spacecraft: int = SPACECRAFT_ID, miss: int | None = None
    ) -> Export:
        """Fly a plan's burns again, sampled for other tools.

        Raises:
            InputError: as `fly_path`, or if there is no such burn to miss.
        """
        check_miss(solution.scenario, miss)
        return cls(solution, fly_path(solution, miss), spacecraft, miss)

    @property
    def mission(self) -> Mission:
        """Mission of the solution."""
        return self.solution.mission

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
    scenario, solution, path = export.mission.scenario, export.solution, export.path
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
        f"a straight line between neighbouring states is within {path.linear_error_m:.1e} m of the "
        f"flight (required: {path.within_m:g}), a cubic of both states within "
        f"{path.cubic_error_m:.1e} m",
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
