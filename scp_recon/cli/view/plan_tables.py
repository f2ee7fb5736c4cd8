"""What the terminal shows: the case, the plan and its verification."""

from __future__ import annotations

from collections.abc import Iterable
from contextlib import suppress

import numpy as np
import numpy.typing as npt
from rich.console import Console
from rich.table import Table
from rich.text import Text

from scp_recon.cli.tables import plain_table
from scp_recon.cli.warnings import show_verdict, show_warnings
from scp_recon.errors import InputError
from scp_recon.mission.constraints import limits_in_words
from scp_recon.mission.mission import Mission
from scp_recon.physics.geometry import angle
from scp_recon.physics.time_scales import instant, iso_utc
from scp_recon.scenario.schema import Scenario
from scp_recon.scenario.warning import ScenarioWarning
from scp_recon.scp.status import Status
from scp_recon.solution.file import Solution, StartsSummary
from scp_recon.solution.risk import Risk
from scp_recon.solution.verdict import Verification
from scp_recon.verification.reintegration import FIGURES, limits_of

Array = npt.NDArray[np.float64]


def show_mission(console: Console, mission: Mission) -> None:
    """Scenario, window, schedule and grid."""
    scenario, schedule = mission.scenario, mission.schedule
    first, last = mission.observed_s or schedule.window_s
    origin = "given" if scenario.observation.window_s else "from incidence and local solar time"
    console.print(
        Text(scenario.name, style="bold")
        + Text(
            f": {scenario.body.name}, site {scenario.site.name}, "
            f"boundary states in {scenario.boundary.frame}, p_chance {scenario.risk.p_chance:g}, "
            f"{scenario.uncertainty.execution}",
            style="not bold",
        )
    )
    if mission.observed_s is None:
        origin += "; over, nothing is observed any more"
    console.print(
        f"window    {first:.1f} to {last:.1f} s ({last - first:.1f} s, {origin})", highlight=False
    )
    start, end = mission.times_s[[0, -1]]
    console.print(
        f"boundary  {_place(mission, start, mission.initial_state)}; "
        f"{_place(mission, end, mission.final_state)}",
        highlight=False,
    )
    legs = ", ".join(f"{leg.mode} {leg.start_s:.0f}-{leg.end_s:.0f}" for leg in schedule.legs)
    console.print(Text(f"schedule  {legs} s"))
    burns = "; ".join(
        f"{time:g} ({_interval(*interval)})" if time else "0"
        for time, interval in zip(scenario.burn_times_s, schedule.firing_intervals_s, strict=True)
    )
    console.print(Text(f"burns     {burns} s, in brackets where each may be moved"))
    if scenario.in_flight is not None:
        console.print(
            f"in flight from {scenario.start_s:g} s on, {scenario.burns_flown} burns flown",
            highlight=False,
        )
    arcs = np.diff(mission.times_s)
    console.print(
        f"grid      {len(mission.times_s)} nodes, {len(mission.window_nodes)} of them in the "
        f"window, arcs of {arcs.min():.0f} to {arcs.max():.0f} s",
        highlight=False,
    )


def _place(mission: Mission, time_s: float, state: Array) -> str:
    """Of a boundary state what does not depend on axes: wrong ones show here, and nowhere else."""
    position, velocity = state[:3], state[3:]
    distance, speed = np.linalg.norm(position), np.linalg.norm(velocity)
    off_sun = np.rad2deg(angle(position, mission.sun_direction(time_s)))
    climb = velocity @ position / distance
    return (
        f"at {time_s:g} s {distance:.0f} m from the centre, {off_sun:.1f} deg off the Sun, "
        f"{speed:.4f} m/s of which {climb:+.4f} upwards"
    )


def _interval(early: float, late: float) -> str:
    return f"{early:.0f} to {late:.0f}" if np.isfinite(late) else f"from {early:.0f}"


def show_solution(console: Console, solution: Solution) -> None:
    """Verdict, burns, constraints."""
    status = Status.named(solution.status)
    colour = "green" if status is Status.CONVERGED else "red"
    iterations = ", ".join(f"{s.name} {s.iterations}" for s in solution.stages)
    console.print(
        Text(f"\n{solution.problem}: ", style=f"bold {colour}")
        + Text(solution.message, style="not bold")
    )
    console.print(_burns(solution))
    console.print(
        f"{frame_and_time(solution.scenario)}", style="dim", highlight=False, soft_wrap=True
    )
    console.print(
        Text.assemble(
            "total delta-v ",
            (f"{solution.total_dv_m_s:.6f} m/s", "bold"),
            f"; iterations: {iterations}; {solution.timing_s.total:.2f} s, of which "
            f"{solution.timing_s.conic_solver:.2f} s in the conic solver\n",
        )
    )
    console.print(_constraints(solution))
    _show_risk(console, solution.risk)
    _show_starts(console, solution.starts)


def _burns(solution: Solution) -> Table:
    table = plain_table("burn", "time s", "x m/s", "y m/s", "z m/s", "size m/s", names=0)
    for number, burn in enumerate(solution.burns, start=1 + solution.scenario.burns_flown):
        size = float(np.linalg.norm(burn.dv_m_s))
        cells = [f"{component:+.6f}" for component in burn.dv_m_s]
        table.add_row(str(number), f"{burn.t_s:g}", *cells, f"{size:.6f}")
    return table


def _constraints(solution: Solution) -> Table:
    """Worst margins; and what is violated without having one, as the final state is."""
    margin = "worst chance margin" if solution.problem == "P2" else "worst margin"
    table = plain_table("constraint", margin, "at s", "facets", "violated by")
    violated = {
        name: Text(f"{amount.max:.4g} {amount.unit}", style="red")
        for name, amount in solution.violation.by_constraint.items()
    }
    for c in solution.constraints:
        table.add_row(
            Text(c.name),
            f"{round(c.worst_margin, 4) + 0.0:+.4f} {c.unit}",
            f"{c.worst_t_s:.0f}",
            str(c.facets or ""),
            violated.pop(c.name, ""),
        )
    for name, amount in violated.items():
        table.add_row(Text(name), "", "", "", amount)
    return table


def frame_and_time(scenario: Scenario) -> str:
    """What the components and the times of a plan's tables count along and from."""
    epoch = scenario.epoch.tdb
    said = f"x, y, z along J2000; times from {epoch.isoformat(timespec='milliseconds')} TDB"
    with suppress(InputError):  # there is no UTC before 1972
        said += f", {iso_utc(instant(epoch))[:-6]} UTC"
    return said


def _show_risk(console: Console, risk: Risk | None) -> None:
    """What was asked, aimed at and reached, in one line."""
    if risk is None:
        return
    what = "of whole flights" if risk.scope == "flight" else "of each constraint at each node"
    line = f"\nprobability {what}: asked {risk.asked:g}, aimed at {risk.aim:.5g}"
    reached = risk.certificate
    if reached is None:
        line += "; not certified: the normal law alone promises it"
    else:
        word = "certified" if reached.low >= risk.asked else "NOT reached"
        line += (
            f"; {word}: {reached.samples} flights reached {reached.reached:.4f} "
            f"({reached.low:.4f} to {reached.high:.4f}) in round {reached.rounds}"
        )
    console.print(line, highlight=False, soft_wrap=True)


def _show_starts(console: Console, starts: StartsSummary | None) -> None:
    """The distinct local optima of several starts."""
    if starts is None:
        return
    found = f"local optima of {starts.number} starts, seed {starts.seed}"
    table = plain_table(found, "delta-v m/s", "starts", "which")
    for optimum in starts.optima:
        which = ", ".join(map(str, optimum.starts[:6])) + (
            ", ..." if len(optimum.starts) > 6 else ""
        )
        table.add_row(
            f"{optimum.problem} {optimum.status}",
            f"{optimum.total_dv_m_s:.6f}",
            str(len(optimum.starts)),
            which,
        )
    console.print()
    console.print(table)


def show_verification(
    console: Console,
    mission: Mission,
    verification: Verification,
    warnings: Iterable[ScenarioWarning] = (),
) -> None:
    """Re-integration, mean margins between the nodes, joint probabilities, warnings and the verdict."""
    v = verification
    console.print()
    console.print(_reintegrated(mission, v))
    console.print(_mean_margins(mission, v))
    console.print(_probabilities(mission, v))
    show_warnings(console, warnings)
    show_verdict(console, "verified", v.failed)
    if v.missed is not None:
        console.print(str(v.missed), highlight=False, soft_wrap=True)
    if v.failed and "status" not in v.failed and _between_nodes(mission, v):
        console.print("What fails does so between nodes: take a smaller grid.step_max_s.")


def _reintegrated(mission: Mission, v: Verification) -> Table:
    """What a flight by another integrator differs by; no limit where it is not judged."""
    table = plain_table("re-integrated", "off by", "allowed")
    limits = limits_of(mission)
    for figure, (name, unit) in FIGURES.items():
        off, most = (f"{x:.1e} {unit}".rstrip() for x in (getattr(v, figure), limits[figure]))
        table.add_row(name, off, most if np.isfinite(limits[figure]) else "")
    return table


def _mean_margins(mission: Mission, v: Verification) -> Table:
    """Of the original constraints, each beside its limit."""
    asked = limits_in_words(mission.scenario)
    table = plain_table("original constraint on the mean", "asked", "worst margin", "at s")
    for m in v.mean_margins:
        margin = {
            "m": f"{m.worst_margin:+.1f} m",
            "m/s": f"{m.worst_margin:+.4f} m/s",
            "rad": f"{np.rad2deg(m.worst_margin):+.2f} deg",
        }[m.unit]
        table.add_row(m.name, asked.get(m.name, ""), margin, f"{m.worst_t_s:.0f}")
    return table


def _probabilities(mission: Mission, v: Verification) -> Table:
    """Of the joint constraints, each beside what was asked."""
    flights, interval = f"Monte Carlo, {v.samples} flights", f"{100 * v.confidence:.0f} % interval"
    table = plain_table(flights, "lowest probability", interval, "at s", "asked")
    asked = f"{mission.scenario.risk.p_chance:g}"
    for p in v.probabilities:
        bounds = f"{p.low:.4f} to {p.high:.4f}"
        table.add_row(p.name, f"{p.estimate:.4f}", bounds, f"{p.worst_t_s:.0f}", asked)
    return table


def _between_nodes(mission: Mission, v: Verification) -> bool:
    """Whether a constraint on the mean, or a probability, fails at its worst where no node is."""
    worst = {m.name: m.worst_t_s for m in v.mean_margins}
    worst |= {f"P({p.name})": p.worst_t_s for p in v.probabilities}
    return any(
        np.abs(mission.times_s - worst[name]).min() > 1.0 for name in v.failed if name in worst
    )
