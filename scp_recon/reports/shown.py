"""Read a plan with what lies beside its file, fly it, and derive all that a page shows of it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import NamedTuple

import numpy as np

from formulations.arrays import Array, Booleans, Indices
from scp_recon.errors import InputError
from scp_recon.mission.mission import Mission
from scp_recon.monte_carlo import summary as summary_file
from scp_recon.monte_carlo.estimates import binomial_quantile, proportion
from scp_recon.monte_carlo.limits import kept_limits, limit_margins
from scp_recon.monte_carlo.sampling import Flyer, flown_mission
from scp_recon.monte_carlo.summary import Summary, read_summary
from scp_recon.physics.frames import unit
from scp_recon.reports.surfaces import Shape, first_hit, rim, shape_of
from scp_recon.reports.tables import or_none
from scp_recon.results.comparison import path_of
from scp_recon.results.read import folder_of, read_solution, resolve_run
from scp_recon.results.solution import Solution
from scp_recon.results.table import Table, columns
from scp_recon.scenario.time_scales import instant, iso_tdb
from scp_recon.simulation import record as record_file
from scp_recon.simulation.record import Record, read_record
from scp_recon.verification.probabilities import SAMPLES, SEED

PLANS_MAX = 6
"""Colours that people without full colour vision tell apart."""
PARTS_PER_ARC = 3
"""Points of a path between two nodes."""
LOOKS_IN_WINDOW, LOOKS = 121, 41
"""Times in the window at which flights are sampled, and at which the view on the ground is drawn."""
SHARE = 0.99
"""Share of the flights whose delta-v stays below a budget."""
SO_FAR = "all of them, from the start so far"
"""Name of the share of flights that have broken no limit so far."""


@dataclass(frozen=True)
class Camera:
    """A round field of view about the boresight, in which the site is kept: full angle, pixels across.

    The default is the DARE SmallSat's in NASA MuSCAT.
    """

    field_deg: float = 21.0
    pixels: int = 5120

    def __str__(self) -> str:
        """The camera in words."""
        return f"camera of {self.field_deg:g} deg and {self.pixels} pixels across"


@dataclass(frozen=True, eq=False)
class DrawnFlights:
    """Flights with the planner's dynamics and the same draws as the verification.

    Attributes:
        times_s: nodes, and even times in the window, shape (n,).
        window: indices of those in the rest of the window, shape (w,).
        positions: J2000, m, shape (n, flights, 3).
        executed_m_s: sizes of the burns as executed, shape (flights, m).
        commanded_m_s: sums of their sizes as commanded, shape (flights,).
        mission: as the flights have it, with their parameters.
    """

    times_s: Array
    window: Indices
    positions: Array
    executed_m_s: Array
    commanded_m_s: Array
    mission: Mission

    @property
    def window_s(self) -> Array:
        """Times in the window, shape (w,)."""
        return self.times_s[self.window]

    @property
    def samples(self) -> int:
        """Number of flights."""
        return len(self.executed_m_s)


class Budget(NamedTuple):
    """Sizes of burns, planned and executed, shape (m,) each, and of a flight's total; m/s.

    Attributes:
        first: number of the first burn, more than 1 in flight.
        high_m_s: quantile `SHARE` of the executions of each burn.
        total_high_m_s: quantile `SHARE` of the flights' totals, and its 95 % confidence interval.
    """

    first: int
    planned_m_s: Array
    mean_m_s: Array
    high_m_s: Array
    total_mean_m_s: float
    total_high_m_s: float
    interval_m_s: tuple[float, float]


class Achieved(NamedTuple):
    """A probability over time with its 95 % interval, shape (n,) each."""

    name: str
    times_s: Array
    value: Array
    low: Array
    high: Array


@dataclass(frozen=True, eq=False)
class Shown:
    """A plan as a page shows it, with flights and simulation of this very plan that lie beside it.

    What follows from the plan is computed once, when it is drawn.

    Attributes:
        name: of the plan on the page.
        solution: the plan.
        camera: whose view is laid on the ground.
        samples: flights that are drawn; None for as many as the verification's.
        summary: of its flights.
        record: of its simulation.
        missed: flights in which a burn is missed, with the way home if that was planned.
        passed_over: names of files beside it that belong to another plan, with the reason.
    """

    name: str
    solution: Solution
    camera: Camera = Camera()
    samples: int | None = None
    summary: Summary | None = None
    record: Record | None = None
    missed: tuple[Summary, ...] = ()
    passed_over: tuple[str, ...] = ()

    @cached_property
    def mission(self) -> Mission:
        """The scenario resolved."""
        return self.solution.mission

    @cached_property
    def shape(self) -> Shape:
        """The body's surface."""
        return shape_of(self.solution.scenario)

    @property
    def nodes_s(self) -> Array:
        """Times of the nodes, shape (n,)."""
        return np.array(self.solution.nodes.t_s)

    @cached_property
    def fine_s(self) -> Array:
        """The nodes' times and even ones between, shape (n,)."""
        nodes, parts = self.nodes_s, np.arange(PARTS_PER_ARC) / PARTS_PER_ARC
        inner = nodes[:-1, None] + np.diff(nodes)[:, None] * parts
        return np.append(inner.ravel(), nodes[-1])

    @property
    def window_s(self) -> tuple[float, float]:
        """Rest of the observation window after the plan's start; empty (end first) once it is over."""
        over = float(self.nodes_s[0]), self.mission.schedule.window_s[1]
        return self.mission.observed_s or over

    def looks_s(self, count: int) -> Array:
        """Even times in the rest of the window, shape (count,); empty after the window."""
        return np.linspace(*self.window_s, count if self.mission.observed_s else 0)

    def positions(self, times_s: Array) -> Array:
        """The planned mean, J2000, m, shape (n, 3): a cubic of the nodes' states between them."""
        return path_of(self.solution)(times_s)

    def fixed(self, times_s: Array) -> Array:
        """The planned mean in the body's frame, m, shape (n, 3)."""
        matrix = self.mission.rotation.body_to_j2000(times_s)
        return np.einsum("nji,nj->ni", matrix, self.positions(times_s))

    @cached_property
    def flown(self) -> DrawnFlights:
        """Flights at the nodes' times and at even ones in the window."""
        samples, (first, last) = self.samples or SAMPLES, self.window_s
        burns, policy = self.solution.burns_m_s, self.solution.corrections
        flyer = Flyer(self.mission, burns, policy, seed=SEED)
        times = np.union1d(self.mission.times_s, self.looks_s(LOOKS_IN_WINDOW))
        positions, executed, commanded = [], [], []
        for block in flyer.fly_blocks(times, samples):
            positions.append(block.states[..., :3])
            executed.append(np.linalg.norm(block.burns_m_s, axis=2))
            commanded.append(np.linalg.norm(block.commanded_m_s, axis=2).sum(axis=1))
        window = np.flatnonzero((times >= first) & (times <= last))
        sizes = np.concatenate(executed), np.concatenate(commanded)
        own = flown_mission(self.mission, SEED, samples)
        return DrawnFlights(times, window, np.concatenate(positions, axis=1), *sizes, own)

    @cached_property
    def achieved(self) -> list[Achieved]:
        """Probabilities of every joint constraint at each time, and of all constraints so far."""
        flown, certain = self.flown, Flyer(self.mission, self.solution.burns_m_s).certain
        times, window = flown.times_s, flown.window
        margins = limit_margins(flown.mission, times, flown.positions, window, certain=certain)
        kept = kept_limits(margins)
        still = np.ones((len(times), flown.samples), dtype=bool)
        for at, those in kept.values():
            still[np.isin(times, at)] &= those
        found = [_estimated(name, at, those) for name, (at, those) in kept.items()]
        return [*found, _estimated(SO_FAR, times, np.logical_and.accumulate(still, axis=0))]

    @cached_property
    def budget(self) -> Budget:
        """Sizes of burns; the interval is that of an order statistic, for any distribution."""
        executed = self.flown.executed_m_s
        totals = np.sort(executed.sum(axis=1))
        ranks = [binomial_quantile(level, len(totals), SHARE) for level in (0.025, 0.975)]
        low, high = totals[np.clip(ranks, 0, len(totals) - 1)]
        return Budget(
            1 + self.solution.scenario.burns_flown,
            np.linalg.norm(self.solution.burns_m_s, axis=1),
            executed.mean(axis=0),
            np.quantile(executed, SHARE, axis=0),
            float(totals.mean()),
            float(np.quantile(totals, SHARE)),
            (float(low), float(high)),
        )

    @cached_property
    def outlines_m(self) -> Array:
        """Edge of the field of view on the ground at `LOOKS` times in the rest of the window.

        The camera points to the site. Body-fixed, shape (w, rays, 3); NaN where a ray misses the body.
        """
        here = self.fixed(self.looks_s(LOOKS))
        boresight = unit(self.mission.site.position_body - here)
        half = float(np.deg2rad(0.5 * self.camera.field_deg))
        rays = np.cos(half) * boresight[:, None] + np.sin(half) * rim(boresight)
        return first_hit(np.broadcast_to(here[:, None], rays.shape), rays, self.shape)


def budget_table(budget: Budget, corrected: bool = False) -> Table:
    """Sizes of each burn and of the whole flight, of burns that gains correct or of planned ones."""
    each = zip(budget.planned_m_s, budget.mean_m_s, budget.high_m_s, strict=True)
    rows = [
        [str(i), *or_none(sizes[0] > 0.0, *map(float, sizes))]
        for i, sizes in enumerate(each, start=budget.first)
    ]
    total = float(budget.planned_m_s.sum())
    rows.append(["whole flight", total, budget.total_mean_m_s, budget.total_high_m_s])
    low, high = budget.interval_m_s
    percent, form = f"{100.0 * SHARE:g} %", " (mm/s) .3f"
    sizes = f"planned{form}", f"executed, mean{form}", f"executed, {percent} stay below{form}"
    return Table.of(
        "Delta-v budget",
        columns("burn", *sizes),
        rows,
        key="budget",
        note=f"95 % interval of the flights' {percent}: {1e3 * low:.3f} to {1e3 * high:.3f} mm/s. "
        "Of the planned burns with their execution errors; "
        + ("corrected by gains." if corrected else "no burns to correct them."),
    )


def plans_of(given: Sequence[Solution | Path], camera: Camera | None = None) -> list[Shown]:
    """Plans with what lies beside their files.

    Raises:
        InputError: if there is none or there are too many, one cannot be read, or they are of
            several bodies, or of one at several epochs.
    """
    if not 1 <= len(given) <= PLANS_MAX:
        raise InputError("plans", f"{len(given)}", f"must be 1 to {PLANS_MAX} plans")
    camera = camera or Camera()
    names = [str(resolve_run(one)) if isinstance(one, Path) else one.scenario.name for one in given]
    found = [
        _read(one, name, camera) if isinstance(one, Path) else Shown(name, one, camera)
        for one, name in zip(given, _distinct(names), strict=True)
    ]
    first = found[0].solution.scenario.body
    for plan in found[1:]:
        other = plan.solution.scenario.body
        if other.name != first.name:
            raise InputError(
                f"plan {plan.name}",
                f"body {other.name}",
                f"must be of {first.name}, as the first",
            )
        if plan.mission.rotation != found[0].mission.rotation:
            raise InputError(
                f"plan {plan.name}",
                f"a body that is turned otherwise, t = 0 at {_begins(plan)}",
                f"must be as the first, t = 0 at {_begins(found[0])}: one view shows one body "
                "(`scp-recon compare` shows the figures of any)",
            )
    return found


def _begins(plan: Shown) -> str:
    return f"{iso_tdb(instant(plan.solution.scenario.epoch.tdb))} TDB"


def _distinct(names: list[str]) -> list[str]:
    """Number the names that occur more than once."""
    return [
        f"{name} ({names[: i + 1].count(name)})" if names.count(name) > 1 else name
        for i, name in enumerate(names)
    ]


def _read(path: Path, name: str, camera: Camera) -> Shown:
    home = resolve_run(path)
    solution, folder = read_solution(home), folder_of(home)
    passed_over, record = list[str](), None

    def flights(names: str) -> list[Summary]:
        """Summaries of the plan's flights, in files beside it."""
        found = {file: read_summary(file) for file in sorted(folder.glob(names))}
        others = [file for file, one in found.items() if not one.is_of(solution)]
        passed_over.extend(f"{file}: flights of another plan" for file in others)
        return [one for one in found.values() if one.is_of(solution)]

    summary = next(iter(flights(summary_file.FILE_NAME)), None)
    missed = tuple(one for one in flights(summary_file.MISSES) if one.drift is not None)
    if (folder / record_file.FILE_NAME).is_file():
        record = read_record(folder)
        if record.plan_hash != solution.plan_hash:
            passed_over.append(f"{folder / record_file.FILE_NAME}: a simulation of another plan")
            record = None
    return Shown(name, solution, camera, None, summary, record, missed, tuple(passed_over))


def _estimated(name: str, times: Array, held: Booleans) -> Achieved:
    estimates = [proportion(int(count), held.shape[1]) for count in held.sum(axis=1)]
    value, low, high = np.array(estimates).T
    return Achieved(name, times, value, low, high)
