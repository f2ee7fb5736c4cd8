"""Show a plan or a design on its way into the folder of a run, and what a failed plan needs."""

from __future__ import annotations

import shlex
from collections.abc import Callable, Iterator, Sequence
from contextlib import AbstractContextManager, ExitStack, contextmanager, nullcontext
from dataclasses import dataclass, field
from importlib.util import find_spec
from pathlib import Path
from time import monotonic, process_time
from typing import Self

import numpy as np
from rich.console import Console

from scp_recon.advice.infeasibility import Diagnosis, cost_of_exact_risk, diagnose
from scp_recon.advice.trials import RETURN, Remedy, for_exact, overrides_of
from scp_recon.api.designing import Design, phases_deg
from scp_recon.api.files import UNVERIFIED, run_folder
from scp_recon.api.inputs import PlanRequest
from scp_recon.api.options import PlanOptions
from scp_recon.api.planning import PlanOutcome, Watch
from scp_recon.certification.largest import rounded_down
from scp_recon.cli import plan_view
from scp_recon.cli.command import Answer, show_line, show_written
from scp_recon.cli.plan_view import Progress, live_progress, plan_document
from scp_recon.cli.views import time_left
from scp_recon.display import digits, mm_s
from scp_recon.errors import option
from scp_recon.files import PICTURE, write_for
from scp_recon.mission.mission import Mission
from scp_recon.passes.design import Trial
from scp_recon.planning.plan import Plan
from scp_recon.planning.primer import WORTH, PrimerHistory
from scp_recon.results.read import point_to
from scp_recon.results.solution import FILE_NAME, Solution
from scp_recon.scenario.schema import Scenario
from scp_recon.scp.status import Status
from scp_recon.verification.causes import causes


def show_largest(budget_m_s: float | None, plan: Plan, console: Console) -> None:
    """Show the largest probability, with its delta-v and the budget."""
    most = "any delta-v" if budget_m_s is None else f"at most {1e3 * budget_m_s:g} mm/s"
    cost = mm_s(plan.cost_m_s, counted=plan.counted)
    result = f"{plan.mission.scenario.risk.p_chance:.5g}, for {cost}"
    show_line(console, f"largest probability found for {most}: {result}")


def write_report_of(outcome: PlanOutcome, console: Console) -> None:
    """Write the report of the plan that was just written, beside its file."""
    from scp_recon.reports import write

    path = outcome.path
    assert path is not None
    aside = path.name == UNVERIFIED
    name = write.UNVERIFIED_NAME if aside else write.FILE_NAME
    given = path if aside else path.parent
    show_written(console, write.write_report([given], path.with_name(name)))


@dataclass(eq=False)
class Shown(Watch):
    """Shows a plan on its way, and keeps it in the folder of a run, which is locked until the end.

    Attributes:
        console: where to show it.
        out: the folder as the user gave it; None for a new one.
        instead: further options of the command for a proposed feasible plan.
        verbose: whether to show all of the mission, each iteration, and the re-integration.
        found: the scenario of a design's pass, for which advised options are tried.
    """

    console: Console
    out: Path | None
    instead: Sequence[str] = ()
    verbose: bool = field(default=False, kw_only=True)
    found: Path | None = None
    _opened: ExitStack = field(default_factory=ExitStack)
    _folder: Path | None = None
    _status: int | None = None
    _began_s: float = field(default_factory=process_time)

    def __enter__(self) -> Self:
        """Begin."""
        return self

    def __exit__(self, *raised: object) -> None:
        """Free the folder; `runs/latest` points to a new one if its run has its answer."""
        self._opened.close()
        is_finished = self._status not in (None, Status.INTERRUPTED.value.exit_code)
        if self.out is None and self._folder is not None and is_finished and raised[0] is None:
            point_to(self._folder)

    def open(self, name: str) -> Path:
        """Open the folder of a run that is named after its scenario; it stays open until the end."""
        if self._folder is None:
            self._folder = self._opened.enter_context(run_folder(self.out, name))
        return self._folder

    def folder(self, scenario: Scenario) -> AbstractContextManager[Path]:
        """See `Watch`."""
        return nullcontext(self.open(scenario.name))

    @contextmanager
    def planning(self, mission: Mission) -> Iterator[Progress]:
        """Show the mission, and the progress of planning."""
        plan_view.show_mission(self.console, mission, verbose=self.verbose)
        if self.verbose:
            self.console.print()
        with live_progress(self.console, mission, verbose=self.verbose) as observe:
            yield observe

    def kept(self, outcome: PlanOutcome, request: PlanRequest) -> tuple[str, ...]:
        """Show the plan and its files; find and show advice on a plan that failed."""
        spent_s = process_time() - self._began_s
        console, mission, solution = self.console, outcome.plan.mission, outcome.solution
        verification, path = outcome.verification, outcome.path
        assert path is not None
        if verification is None:
            plan_view.show_plan(console, mission, solution, solution.warnings)
            show_written(console, path)
            return ()
        how = {"advised": not verification.ok, "verbose": self.verbose}
        plan_view.show_plan(console, mission, solution, mission.warnings, **how)
        for old in outcome.aside:
            show_line(console, f"set aside because it belongs to another plan: {old}")
        if path.name == UNVERIFIED:
            show_line(console, f"kept, as it is verified: {path.with_name(FILE_NAME)}")
        show_written(console, path)
        if verification.ok:
            lines = saving(outcome, request, spent_s, self.instead)
            advised = bool(lines)
        else:
            with plan_view.live_line(console) as show:
                diagnosis = diagnose(outcome.plan, request, spent_s, show, verification)
            advised = bool(diagnosis.remedies)
            lines = advice_on(diagnosis, outcome.plan, self.instead, path)
            if outcome.plan.status is Status.CONVERGED:
                lines = (*causes(mission, verification), *lines)
        if self.found is not None and advised:
            lines = (*lines, f"these options are for solve --scenario {self.found}")
        for line in lines:
            show_line(console, line)
        return lines

    def answer(self, outcome: PlanOutcome) -> Answer:
        """The exit status and the document of a plan."""
        assert outcome.path is not None
        self._status = plan_view.exit_code(outcome.solution)
        return Answer(self._status, plan_document(outcome.solution, [outcome.path]))


def advice_on(
    diagnosis: Diagnosis, failed: Plan, more: Sequence[str] = (), file: Path = Path(FILE_NAME)
) -> tuple[str, ...]:
    """Lines on what binds, on options that were tried and work, and on what did not.

    `more` are options that undo those of the command that exclude exact risk; `file` is the plan's.
    """
    risk, found = failed.mission.scenario.risk, diagnosis
    lines = []
    if failed.status is Status.INFEASIBLE:
        binds = ", ".join(one.name for one in found.remedies) or "nothing that suffices alone"
        several = "; relaxing any one of them suffices" if len(found.remedies) > 1 else ""
        lines.append(f"what binds: {binds}{several}")
        if found.without_uncertainty is Status.INFEASIBLE:
            lines.append("without uncertainty it is infeasible too: no lower probability helps")
        elif failed.final.problem == "P3":
            lines.append("without uncertainty it is infeasible too: not asked for")
        elif found.without_uncertainty is not Status.CONVERGED:
            how = found.without_uncertainty.value.name
            lines.append(f"without uncertainty planning ended {how}, which shows little")
    if found.kept is not None:
        lines.append(f"flights of this plan kept every limit with {found.kept:.4f}")
    if found.miss is not None:
        lines.append(
            f"a plan that may miss the final state ends {digits(found.miss[0], 3)} m and "
            f"{digits(1e3 * found.miss[1], 3)} mm/s off it"
        )
    if found.largest is not None:
        what = "whole flights" if risk.scope == "flight" else "each constraint at each node"
        words = f"the largest probability found feasible with exact risk, of {what}"
        lines.append(f"{words}: {rounded_down(found.largest):g} by the normal law")
    lines += [f"{one.name}: {what_would_do(one, more, file)}" for one in found.remedies]
    if not found.remedies:
        lines.append("no values were found with which this command ends verified")
    if found.tried:
        lines.append(f"tried, and not sufficient alone: {', '.join(found.tried)}")
    if found.left_out:
        words = f"not tried to the end, after {found.limit_s:.0f} s of the processor"
        lines.append(f"{words}: {', '.join(found.left_out)}")
    return tuple(lines)


def saving(
    outcome: PlanOutcome, request: PlanRequest, spent_s: float, more: Sequence[str] = ()
) -> tuple[str, ...]:
    """A line on what exact risk would save of a verified plan's delta-v; see `advice_on`."""
    if (cost := cost_of_exact_risk(outcome.plan, request, spent_s)) is None:
        return ()
    options = " ".join([*more, "--set", shlex.quote('risk.allocation="exact"')])
    saved = mm_s(outcome.plan.cost_m_s - cost, 1)
    words = f"next: exact risk saves {saved} ({mm_s(cost, 1)} by the normal law"
    return (f"{words}, before flights certify the plan), with: {options}",)


def undoing(options: PlanOptions) -> list[str]:
    """Options that, added to those of a command, allow exact risk and a given probability."""
    allowed, undone = for_exact(options), []
    for name in ("method", "formulation", "facet_rounds", "objective", "dv_budget_m_s"):
        value = getattr(allowed, name)
        if value != getattr(options, name):
            called = "dv-budget" if name == "dv_budget_m_s" else name.replace("_", "-")
            undone += [f"--{called}", "any" if value is None else str(value)]
    return undone


def what_would_do(remedy: Remedy, more: Sequence[str] = (), file: Path = Path(FILE_NAME)) -> str:
    """Options with which the command ended verified, and the delta-v of that plan."""
    turns = "risk.allocation" in remedy.changes or "risk.p_chance" in remedy.changes
    options = [*(more if turns else ()), *(("--goal", "return") if remedy.name == RETURN else ())]
    if not remedy.changes and remedy.certify is None:
        options += ["--init", str(file)]
    for override in overrides_of({} if remedy.name == RETURN else remedy.changes):
        options += ["--set", shlex.quote(override)]
    if remedy.certify is not None:
        options += ["--certify", "yes" if remedy.certify else "no"]
    return f"feasible, for {mm_s(remedy.cost_m_s, 1, remedy.counted)}, with: {' '.join(options)}"


# --- designs ---------------------------------------------------------------------------------------

TABLE, SCENARIO, MAP, PRIMER = "design.csv", "scenario.toml", "design.png", "primer.png"
"""What a design writes besides its plan."""
HEAD = "# Written by `scp-recon design`.\n"
MARKS = {TABLE: b"step,window,problem,", SCENARIO: HEAD.encode(), MAP: PICTURE, PRIMER: PICTURE}
"""What only this program's files of these names hold."""
OF_MAP = 4.0
"""Time of a design over that of its maps: 2.9 was measured for Nightingale, 4.9 for Sandpiper."""
RESIDUAL = 0.1
"""Largest residual of an optimum's multipliers: a primer errs by its residual."""


def draw_map(found: Design, folder: Path, console: Console) -> None:
    """Write a design's map, if plans from a home orbit converged and matplotlib is installed."""
    mapped = found.best.space.has_home and any(one.result.converged for one in found.trials)
    if mapped and find_spec("matplotlib") is None:
        show_line(console, f"no {MAP}, no {PRIMER}: pip install 'scp_recon[report]' for them")
    elif mapped:
        from scp_recon.reports import pictures

        write_for(option("out"), folder / MAP, pictures.draw_design(found.trials, found.best))


def draw_primer(solution: Solution, folder: Path) -> None:
    """Write the picture of a plan's primer, if it has one and matplotlib is installed."""
    if solution.primer is not None and find_spec("matplotlib") is not None:
        from scp_recon.reports import pictures

        times = [burn.t_s for _, burn in solution.executed]
        write_for(option("out"), folder / PRIMER, pictures.draw_primer(solution.primer, times))


@contextmanager
def design_progress(console: Console) -> Iterator[Callable[[Trial], None]]:
    """Yield a function that counts plans; the best plan of each step gets a line."""
    trials: dict[str, list[Trial]] = {}
    begun, map_s = monotonic(), 0.0

    def line(step: str) -> str:
        best, number = min(trials[step], key=lambda one: one.result.dv_m_s), len(trials[step])
        count = f"{step:10} {number:4} plan{'s' if number > 1 else ''}"
        if not best.result.converged:
            return f"{count}, none that holds"
        phases = phases_deg(best.result)
        counted = best.result.mission.scenario.policy.cost if step == "corrected" else "nominal"
        between = "" if None in phases else " from {:.1f} to {:.1f} deg".format(*phases)
        return f"{count}, best {mm_s(best.result.dv_m_s, counted=counted)}{between}" + (
            ", without uncertainty" if step in ("map", "certain") else ""
        )

    with console.status("designing") as status:

        def count(tried: Trial) -> None:
            nonlocal map_s
            if tried.step not in trials and trials:
                console.print(line(next(reversed(trials))), highlight=False)
            same = trials.setdefault(tried.step, [])
            same.append(tried)
            took_s = monotonic() - begun
            if tried.expected is None:
                time = time_left(took_s, OF_MAP * map_s, took_s)
                left = f"; {time}, then its plan"
            else:
                spaces = {one.result.space.number for one in same}
                total, map_s = tried.expected * len(spaces), took_s
                time = time_left(len(same), total, took_s)
                left = f"; of {total}, {time}, then descents from the map's minima"
            status.update(line(tried.step) + (left if time else ""))

        yield count
    if trials:
        console.print(line(next(reversed(trials))), highlight=False)


def primer_says(primer: PrimerHistory | None) -> str:
    """Whether one more burn would help, by a plan's primer, in one line."""
    if primer is None:
        return "no primer: it needs a plan whose errors shrink with the burns"
    legal = np.flatnonzero(primer.legal)
    if len(legal) == 0:
        return "primer: no time is legal for another burn with the present ones kept"
    if primer.residual > RESIDUAL:
        left = f"leave a residual of {primer.residual:.2g}, at most {RESIDUAL:g} expected"
        return f"primer: its multipliers {left}: no conclusion about another burn"
    best = legal[np.argmax(np.array(primer.allowed)[legal])]
    most, when = primer.allowed[best], f"at {primer.t_s[best]:.0f} s"
    if most <= 1.0 + WORTH:
        return f"primer at most {most:.3f} at legal times ({when}): no additional small burn helps"
    return f"primer up to {most:.3f} at legal times: an additional burn {when} would help"
