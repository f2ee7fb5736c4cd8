"""Show a plan on the terminal: case, iterations, burns and verification."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console, Group, RenderableType
from rich.live import Live
from rich.text import Text

from formulations.arrays import Array
from scp_recon.bodies.catalogue import AU_KM, packaged_body
from scp_recon.cli.command import NOT_VERIFIED, show_line
from scp_recon.cli.views import show_headline, show_table, show_verdict, show_warnings, terminal
from scp_recon.display import mm_s
from scp_recon.errors import InputError
from scp_recon.interop.export import Export
from scp_recon.mission import knowledge
from scp_recon.mission.constraints import required_in_words
from scp_recon.mission.mission import Mission
from scp_recon.mission.scene import Scene, orbit_of_body
from scp_recon.monte_carlo.estimates import Estimate
from scp_recon.physics.geometry import angle
from scp_recon.planning.plan import Plan
from scp_recon.reports import tables
from scp_recon.results.solution import Solution, iteration_record
from scp_recon.results.table import Cell, Table
from scp_recon.results.verification import Verification, in_words
from scp_recon.scenario.fields import ScenarioWarning
from scp_recon.scenario.time_scales import instant, iso_tdb, iso_utc
from scp_recon.scp.loop import Record
from scp_recon.scp.status import Status
from scp_recon.verification.causes import IMPACT_WARNED, in_doubt, next_lines
from scp_recon.verification.reintegration import FIGURES


def show_mission(console: Console, mission: Mission, *, verbose: bool = True) -> None:
    """What is planned and required, and the window; boundary states, schedule and grid if `verbose`."""
    scenario, schedule = mission.scenario, mission.schedule
    first, last = mission.observed_s or schedule.window_s
    origin = "given" if scenario.observation.window_s else "by incidence and solar time"
    place = f"{scenario.body.name}, site {scenario.site.name}"
    what = f"{place}; {required_in_words(scenario)}; {scenario.uncertainty.execution}"
    show_headline(console, scenario.name, what)
    if packaged_body(scenario.body.name) is None:
        show_line(console, f"body      {as_given(mission.scene)}")
    if scenario.observation.required is False:
        origin += "; not required, nothing is observed"
    elif mission.observed_s is None:
        origin += "; over, nothing is observed any more"
    span = (
        f"{first:.1f} to {last:.1f} s ({last - first:.1f} s, {origin}){tables.own_windows(mission)}"
    )
    show_line(console, f"window    {span}; boundary in {scenario.boundary.frame} axes")
    if mission.uncertain.count:
        show_line(console, f"uncertain {knowledge.in_words(scenario)} (1 sigma)")
    if scenario.in_flight is not None:
        since = f"from {scenario.start_s:g} s on, {scenario.burns_flown} burns flown"
        show_line(console, f"in flight {since}")
    if not verbose:
        return
    ends = mission.times_s[[0, -1]], (mission.initial_state, mission.final_state)
    places = (place_of(mission, time, state) for time, state in zip(*ends, strict=True))
    show_line(console, f"boundary  {'; '.join(places)}")
    legs = ", ".join(f"{leg.mode} {leg.start_s:.0f}-{leg.end_s:.0f}" for leg in schedule.legs)
    show_line(console, f"schedule  {legs} s")
    nodes, arcs = len(mission.times_s), np.diff(mission.times_s)
    grid = f"{nodes} nodes, {len(mission.window_nodes)} of them in the window"
    show_line(console, f"grid      {grid}, arcs of {arcs.min():.0f} to {arcs.max():.0f} s")


def as_given(scene: Scene) -> str:
    """Entries of a body that is not packaged and that no check can test, in words."""
    body, spin = scene.scenario.body, scene.rotation
    axis = spin.pole * np.sign(spin.rate)
    tilt = np.rad2deg(angle(axis, orbit_of_body(scene).normal))
    north = 90.0 - np.rad2deg(angle(axis, scene.sun_direction(0.0)))
    away = np.linalg.norm(scene.scenario.sun.body_position_km) / AU_KM
    way, side = "backwards" if tilt > 90.0 else "forwards", "north" if north > 0.0 else "south"
    return (
        f"{body.name} is not packaged, and taken as given: it turns in {spin.period_h:.4g} h, {way} "
        f"(its axis {tilt:.0f} deg off that of its orbit); the Sun is {away:.3f} au away, "
        f"{abs(north):.0f} deg {side} of its equator"
    )


def place_of(mission: Mission, time_s: float, state: Array) -> str:
    """A boundary state in words that reveal wrong axes, which no check can detect."""
    position, velocity = state[:3], state[3:]
    distance, speed = np.linalg.norm(position), np.linalg.norm(velocity)
    off_sun = np.rad2deg(angle(position, mission.sun_direction(time_s)))
    climb = velocity @ position / distance
    latitude = 90.0 - np.rad2deg(angle(position, mission.rotation.pole))
    normal = np.cross(position, velocity)
    tilt = np.rad2deg(angle(normal, mission.sun_direction(time_s)))
    return (
        f"at {time_s:g} s {distance:.0f} m from the centre, over latitude {latitude:+.0f} deg, "
        f"{off_sun:.1f} deg off the Sun, {speed:.4f} m/s of which {climb:+.4f} upwards, in a plane "
        f"{min(tilt, 180.0 - tilt):.0f} deg off the terminator's"
    )


def show_plan(
    console: Console,
    mission: Mission,
    solution: Solution,
    warnings: Iterable[ScenarioWarning] = (),
    *,
    advised: bool = False,
    verbose: bool = False,
) -> None:
    """Show the verdict, the burns, the limits with their probabilities, and what to do next.

    Args:
        console: to print to.
        mission: that was planned.
        solution: the plan, verified unless it was interrupted.
        warnings: on the scenario.
        advised: whether advice on this plan follows, in place of the causes of failed checks.
        verbose: whether margins at the nodes, the re-integration, local optima and every share of a
            burn cut short are shown too.
    """
    status, verification = Status.named(solution.status), solution.verification
    doubts = in_doubt(solution, verification, warnings)
    many = f"{len(doubts)} warning{'s' if len(doubts) > 1 else ''} above" if doubts else None
    show_warnings(console, doubts)
    console.print()
    if verification is not None:
        show_verdict(console, "verified", [in_words(name) for name in verification.failed], many)
        if verification.missed is not None:
            show_line(console, str(verification.missed))
    colour = "green" if status is Status.CONVERGED else "red"
    show_headline(console, solution.problem, status.value.message, colour)
    _show_cost(console, solution, verbose=verbose)
    show_table(console, tables.burns_table(solution, mission.schedule.firing_intervals_s), "UTC")
    epoch = solution.scenario.epoch.tdb
    times = f"times from {epoch.isoformat(timespec='milliseconds')} TDB"
    with suppress(InputError):  # there is no UTC before 1972
        times += f", {iso_utc(instant(epoch))[:-6]} UTC"
    show_line(console, f"x, y, z along J2000; {times}", "dim")
    if solution.by_policy is not None:
        show_line(console, solution.by_policy)
    if solution.policy is not None:
        show_table(console, tables.corrections_table(solution))
        show_line(console, f"{solution.policy}; of the plan itself {mm_s(solution.total_dv_m_s)}")
    if verbose or verification is None:
        console.print(terminal(tables.constraints_table(solution).without("kind")))
    if (risk := solution.risk) is not None:
        what = "of whole flights" if risk.scope == "flight" else "of each constraint at each node"
        line = f"probability {what}: required {risk.required:g}, target {risk.target:.5g}"
        if (reached := risk.certificate) is None:
            line += "; not certified: the normal law alone promises it"
        else:
            word = "certified" if reached.certifies(risk.required) else "NOT reached"
            line += f"; {word}: {reached}"
        show_line(console, line)
    if solution.starts is not None:
        if verbose:
            console.print(terminal(tables.starts_table(solution.starts)))
        show_line(console, str(solution.starts), "dim")
    if verification is not None:
        _show_verification(console, mission, solution, verification, verbose=verbose)
        if not advised and not verification.ok:
            for line in next_lines(mission, solution, verification):
                show_line(console, line)


def _show_cost(console: Console, solution: Solution, *, verbose: bool) -> None:
    """Show delta-v, iterations and times."""
    reached = None if solution.risk is None else solution.risk.certificate
    of = " of the last plan" if reached and reached.rounds + reached.tests > 2 else ""
    iterations = ", ".join(f"{s.name} {s.iterations}" for s in solution.stages)
    total = mm_s(solution.total_dv_m_s)
    more = f"; iterations{of}: {iterations}; {solution.timing_s.total:.2f} s"
    console.print(Text.assemble("total delta-v ", (total, "bold"), more), soft_wrap=True)
    if solution.cost_in_words:
        show_line(console, solution.cost_in_words)
    if verbose:
        for stage in solution.stages:
            if stage.meaning:
                show_line(console, f"{stage.name}: {stage.meaning}", "dim")
        show_line(console, f"conic solver: {solution.timing_s.conic_solver:.2f} s", "dim")


def _show_verification(
    console: Console, mission: Mission, solution: Solution, v: Verification, *, verbose: bool
) -> None:
    """Show the limits and the drifts; the re-integration if `verbose`, or if it differs too much."""
    if verbose or FIGURES.keys() & {*v.failed}:
        console.print(terminal(tables.reintegration_table(mission, v)))
    limits = tables.limits_table(mission, solution, v)
    if not verbose:
        idle = {d.row for d in v.drifts if d.share and not d.binds}
        limits = replace(limits, rows=tuple(row for row in limits.rows if row[0].text not in idle))
    show_table(console, limits, f"{100 * v.confidence:.0f} % interval")
    if (nearest := v.nearest_drift) is not None and nearest.impact < IMPACT_WARNED:
        show_line(console, str(nearest))
    if v.lost_contacts:
        show_table(console, tables.lost_contacts_table(v))
    if v.burn_limits:
        show_table(console, tables.burn_limits_table(v, mission.scenario.risk.p_chance))


@dataclass
class Progress:
    """The planner's observer: a table that grows by a row per iteration, and lines of flights above it.

    Attributes:
        verbose: whether the table of iterations and all lines on flights are shown.
        doing: the last iteration or flights in words, in place of the table on a terminal.
        steps: lines on flights, by the calibration or test.
        plain: flights of a calibration or test if none were left out.
    """

    mission: Mission
    live: Live
    table: Table
    verbose: bool
    doing: str = ""
    steps: dict[str, Text] = field(default_factory=dict)
    plain: dict[str, int] = field(default_factory=dict)

    def __call__(self, stage: str, record: Record) -> None:
        """An iteration is done."""
        r = iteration_record(self.mission, stage, record)
        row = tables.iteration_row(r)
        if record.failure:
            row[2:] = [Cell("solver failed", style="doubtful"), *[None] * (len(row) - 3)]
        elif not r.accepted:
            row[4] = Cell(f"({1e3 * r.actual:.2e})", r.actual)
        self.table = self.table.with_rows([row])
        self.doing = f"{stage}, iteration {r.k}: {mm_s(r.merit)}, violation {r.max_violation:.1e} m"
        self._refresh()

    def flights(
        self, step: str, plan: Plan, samples: int, flown: int = 0, reached: Estimate | None = None
    ) -> None:
        """Show how many flights of a calibration or a test are flown, or their result."""
        said = (
            f"{flown} flown"
            if reached is None
            else f"{reached.value:.4f}, at least {reached.low:.4f}"
        )
        how = "" if samples == self.plain.setdefault(step, samples) else " in strata"
        self.doing = (
            f"{step}: target {plan.target:.5g}, {mm_s(plan.total_dv_m_s)}, "
            f"{len(plan.times_s)} nodes; {samples} flights{how}: {said}"
        )
        self.steps[step] = Text(self.doing)
        self._refresh()

    def end(self) -> None:
        """Planning is done."""
        self.doing = ""
        self._refresh()

    def _refresh(self) -> None:
        shown: list[RenderableType] = []
        if self.verbose:
            table = terminal(self.table.without("step"), narrow=True)
            shown = [*self.steps.values(), table]
        elif self.doing and self.live.console.is_terminal:
            shown = [Text(self.doing, style="dim")]
        self.live.update(Group(*shown), refresh=True)


@contextmanager
def live_progress(console: Console, mission: Mission, *, verbose: bool) -> Iterator[Progress]:
    """Show the progress of planning until it ends; each iteration if `verbose`."""
    # Redrawn on every row and never from a thread, so that a captured log holds the table once.
    with Live(console=console, auto_refresh=False) as live:
        shown = Progress(
            mission, live, Table.of("Iterations", tables.ITERATION_COLUMNS, ()), verbose
        )
        try:
            yield shown
        finally:
            shown.end()
    if not verbose:
        return
    console.print(
        "\nmerit: total delta-v plus penalties; in brackets: step rejected; violation and defect: "
        "velocities count as metres per unit of time",
        style="dim",
    )


@contextmanager
def live_line(console: Console) -> Iterator[Callable[[str], None]]:
    """Yield a function that shows a line while work lasts, on a terminal alone."""
    with Live(console=console, auto_refresh=False, transient=True) as live:

        def show(text: str) -> None:
            if console.is_terminal:
                live.update(Text(text, style="dim"), refresh=True)

        yield show


FRAME = "J2000, body-centred"
IN_FILE = {"nodes", "facets", "iterations", "scenario", "timing_s", "units"}
"""Parts of a solution that are only in its file, not in the command's document."""


def plan_document(solution: Solution, files: Iterable[Path] = ()) -> dict[str, Any]:
    """Document of a plan without its grid: verdict, burns, margins, risk, verification, files."""
    return {
        "scenario": solution.scenario.name,
        "frame": FRAME,
        "plan_hash": solution.plan_hash,
        "plan": {key: value for key, value in solution.document().items() if key not in IN_FILE},
        "files": [str(file) for file in files],
    }


def exit_code(solution: Solution) -> int:
    """The exit status for a plan that was made: of its planning, else of its verification."""
    failed = solution.verification is not None and not solution.verification.ok
    return Status.named(solution.status).value.exit_code or (NOT_VERIFIED if failed else 0)


def export_document(found: Export, files: Iterable[Path]) -> dict[str, Any]:
    """Document of an export: the path, the burns with their dates, and the files."""
    return {
        "verdict": found.verdict,
        "files": [str(file) for file in files],
        "frame": FRAME,
        "states": found.size,
        "linear_error_m": found.linear_error_m,
        "cubic_error_m": found.cubic_error_m,
        "asked_error_m": found.within_m,
        "burns": [
            {
                "t_s": burn.t_s,
                "tdb": iso_tdb(found.instant(burn.t_s)),
                "utc": iso_utc(found.instant(burn.t_s)),
                "dv_m_s": burn.dv_m_s,
            }
            for burn in found.solution.burns
        ],
        "plan_hash": found.solution.plan_hash,
    }
