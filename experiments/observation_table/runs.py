"""A row of the observation-time table from its folder, or computed and left there."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from experiments.observation_table.rows import Row
from scp_recon.errors import InputError
from scp_recon.mission.mission import Mission
from scp_recon.monte_carlo.estimates import Estimate
from scp_recon.monte_carlo.flights import FlightConfig, fly_many
from scp_recon.monte_carlo.observation_time import ALL, SCIENCE, joint_margins, time_held
from scp_recon.monte_carlo.sampling import sample_positions
from scp_recon.monte_carlo.summary import FILE_NAME, ONE_SIGMA, Summary, read_summary_as, summarise
from scp_recon.results.read import read_solution
from scp_recon.results.solution import FILE_NAME as SOLUTION_FILE
from scp_recon.results.solution import NOT_OPTIMISED, Solution
from scp_recon.scenario.fields import Section
from scp_recon.verification.reintegration import verify

UNIFORM_STEP_S = 232.0
"""The paper's time step, on a grid that need not contain the window's edges."""

COUNTED_MAX = 10_000
"""Flights counted there; more would not fit memory and the difference is clear from these."""


class Counted(Section):
    """Observation times of flights looked at only at the nodes of the paper's uniform grid, s."""

    nodes: int
    mean_s: float
    worst_1_sigma_s: float


class RowSummary(Summary):
    """A Monte Carlo summary, and what this study adds to it."""

    counted_on_uniform_grid: Counted


@dataclass(frozen=True)
class Measured:
    """A row with what its flights showed.

    The window is its length, the time without uncertainty that of the plan itself; it is `reused` where
    nothing had to be computed.
    """

    row: Row
    solution: Solution
    summary: RowSummary
    window_s: float
    without_uncertainty_s: float
    reused: bool = False

    @property
    def mean(self) -> Estimate:
        """Mean observation time, s."""
        return self.summary.held_s[ALL].mean.estimate

    @property
    def worst_1_sigma(self) -> Estimate:
        """Observation time that all but the worst 15.9 % of flights reach, s."""
        return self.summary.held_s[ALL].worst_1_sigma.estimate

    @property
    def full_at_1_sigma(self) -> bool:
        """Whether surely no more than 15.9 % of flights lose any of the window."""
        return self.summary.held_s[ALL].throughout.estimate.low >= 1.0 - ONE_SIGMA

    @property
    def closest(self) -> Estimate:
        """Distance from the body's centre at the 0.3 % quantile, m."""
        return self.summary.closest_m.worst.estimate

    @property
    def lowest_joint(self) -> tuple[str, Estimate]:
        """The least probable joint constraint at its least probable time."""
        found = {k: p.estimate for k, p in self.summary.probability.items() if k != ALL}
        name = min(found, key=lambda k: found[k].value)
        return name, found[name]

    @property
    def all_at_once(self) -> Estimate:
        """Probability that all observation constraints hold where it is smallest."""
        return self.summary.probability[ALL].estimate

    @property
    def status(self) -> str:
        """How the design ended, and whether it was verified."""
        if self.solution.algorithm == NOT_OPTIMISED:
            return "given, not optimised"
        v = self.solution.verification
        words = "" if v is None else ", verified" if v.ok else f", not verified: {v.failed}"
        return f"{self.solution.problem} {self.solution.status}{words}"


@dataclass(frozen=True)
class Failed:
    """A row that could not be computed, and why."""

    row: Row
    reason: str


def run_row(
    row: Row, mission: Mission, folder: Path, *, samples: int, check: bool, fresh: bool = False
) -> Measured:
    """Design the row's burns and fly them, as far as the folder does not hold that already.

    It gets the row's solution.json and montecarlo.json. With `check` a plan is verified independently
    of its solver; `fresh` forgets what is there.
    """
    folder.mkdir(parents=True, exist_ok=True)
    if fresh:  # a row that then fails leaves nothing that looks like its result
        for name in (SOLUTION_FILE, FILE_NAME):
            (folder / name).unlink(missing_ok=True)
    solution = None if row.anew else _stored_solution(folder, mission, check)
    designed = solution is None
    if solution is None:
        solution = row.design(mission)
        if check and solution.algorithm != NOT_OPTIMISED:
            found = verify(mission, solution)
            solution = solution.with_verification(found)
        solution.write(folder)
    summary = _stored_summary(folder, solution, samples)
    flown = summary is None
    if summary is None:
        summary = _fly(mission, solution, samples)
        summary.write(folder)
    first, last = mission.schedule.window_s
    return Measured(
        row,
        solution,
        summary,
        window_s=last - first,
        without_uncertainty_s=_nominal_time(mission, solution),
        reused=not (designed or flown),
    )


def _stored_solution(folder: Path, mission: Mission, check: bool) -> Solution | None:
    try:
        solution = read_solution(folder)
    except InputError:
        return None
    planned = solution.algorithm != NOT_OPTIMISED
    if solution.scenario != mission.scenario or (check and planned and not solution.verification):
        return None
    return solution


def _stored_summary(folder: Path, solution: Solution, samples: int) -> RowSummary | None:
    """What the folder holds of as many flights of this very plan as are asked for."""
    try:
        found = read_summary_as(RowSummary, folder / FILE_NAME)
    except InputError:
        return None
    setting = found.samples, found.seed, found.truth, found.errors
    as_asked = setting == (samples, 0, "planner", "componentwise")
    return found if as_asked and found.is_of(solution) else None


def _fly(mission: Mission, solution: Solution, samples: int) -> RowSummary:
    flown = fly_many(FlightConfig(mission, solution.burns_m_s), samples=samples)
    counted = _counted(mission, solution, min(samples, COUNTED_MAX))
    return RowSummary(**dict(summarise(flown, solution)), counted_on_uniform_grid=counted)


def _nominal_time(mission: Mission, solution: Solution) -> float:
    """Time in which the mean itself holds all observation constraints, s."""
    window = mission.window_nodes
    states = np.array(solution.nodes.state)[window, None]
    return float(time_held(mission, mission.times_s[window], states)[ALL].duration[0])


def _counted(mission: Mission, solution: Solution, samples: int) -> Counted:
    """Observation time as the share of the paper's uniform nodes at which all constraints hold."""
    end, (first, last) = mission.times_s[-1], mission.schedule.window_s
    grid = np.linspace(0.0, end, int(end // UNIFORM_STEP_S) + 1)
    nodes = grid[(grid >= first) & (grid <= last)]
    positions = sample_positions(mission, solution.burns_m_s, nodes, samples)
    joint = joint_margins(mission, nodes, positions)
    holds = np.logical_and.reduce([joint[name] >= 0.0 for name in SCIENCE])
    seconds = holds.mean(axis=0) * (last - first)
    return Counted(
        nodes=len(nodes),
        mean_s=float(seconds.mean()),
        worst_1_sigma_s=float(np.quantile(seconds, ONE_SIGMA)),
    )
