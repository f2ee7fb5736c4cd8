"""Show a plan on its way into the folder of a run; for an infeasible plan show feasible options."""

from __future__ import annotations

import shlex
from collections.abc import Iterator, Sequence
from contextlib import AbstractContextManager, ExitStack, contextmanager, nullcontext
from pathlib import Path
from time import process_time
from typing import Self

from rich.console import Console

from scp_recon.advice.infeasibility import Diagnosis, cost_of_exact_risk, diagnose
from scp_recon.advice.trials import RETURN, Remedy, for_exact, overrides_of
from scp_recon.api.inputs import PlanRequest
from scp_recon.api.keeping import UNVERIFIED, point_latest, run_folder
from scp_recon.api.options import PlanOptions
from scp_recon.api.planning import PlanOutcome, Watch
from scp_recon.certification.largest import rounded_down
from scp_recon.cli import plan_view
from scp_recon.cli.command import (
    NOT_VERIFIED,
    Answer,
    show_line,
    show_written,
)
from scp_recon.cli.plan_view import Progress, live_progress, plan_document
from scp_recon.display import digits, mm_s
from scp_recon.mission.mission import Mission
from scp_recon.planning.plan import Plan
from scp_recon.results.solution import FILE_NAME
from scp_recon.scenario.schema import Scenario
from scp_recon.scp.status import Status
from scp_recon.verification.causes import causes


def show_largest(budget_m_s: float | None, plan: Plan, console: Console) -> None:
    """Show the largest probability, with its delta-v and the budget."""
    most = "any delta-v" if budget_m_s is None else f"at most {1e3 * budget_m_s:g} mm/s"
    cost = mm_s(plan.cost_m_s, counted=plan.counted)
    result = f"{plan.mission.scenario.risk.p_chance:.5g}, for {cost}"
    show_line(console, f"largest probability found for {most}: {result}")


def write_report_of(folder: Path, console: Console) -> None:
    """Write the report of the plan that was just written."""
    from scp_recon.reports import write

    aside = folder / UNVERIFIED
    if aside.is_file():
        path = write.write_report([aside], aside.with_name(write.UNVERIFIED_NAME))
    else:
        path = write.write_report([folder], folder / write.FILE_NAME)
    show_written(console, path)


class Shown(Watch):
    """Shows a plan on its way, and keeps it in the folder of a run, which is locked until the end.

    Args:
        console: where to show it.
        out: the folder as the user gave it; None for a new one.
        instead: further options of the command for a proposed feasible plan.
        verbose: whether to show all of the mission, each iteration, and the re-integration.

    Attributes:
        found: the scenario of a design's pass, for which advised options are tried.
    """

    found: Path | None = None

    def __init__(
        self,
        console: Console,
        out: Path | None,
        instead: Sequence[str] = (),
        *,
        verbose: bool = False,
    ) -> None:
        self._verbose = verbose
        self._console, self._out, self._instead = console, out, instead
        self._open = ExitStack()
        self._status: int | None = None
        self._folder: Path | None = None
        self._began_s = process_time()

    def __enter__(self) -> Self:
        """Begin."""
        return self

    def __exit__(self, *raised: object) -> None:
        """Free the folder; `runs/latest` points to it if the run has its answer."""
        self._open.close()
        if self._folder is not None and self._status is not None and raised[0] is None:
            point_latest(self._out, self._folder, self._status)

    def open(self, name: str) -> Path:
        """Open the folder of a run that is named after its scenario; it stays open until the end."""
        if self._folder is None:
            self._folder = self._open.enter_context(run_folder(self._out, name))
        return self._folder

    def folder(self, scenario: Scenario) -> AbstractContextManager[Path]:
        """See `Watch`."""
        return nullcontext(self.open(scenario.name))

    @contextmanager
    def planning(self, mission: Mission) -> Iterator[Progress]:
        """Show the mission, and the progress of planning."""
        plan_view.show_mission(self._console, mission, verbose=self._verbose)
        if self._verbose:
            self._console.print()
        with live_progress(self._console, mission, verbose=self._verbose) as observe:
            yield observe

    def planned(self, outcome: PlanOutcome) -> None:
        """Show an interrupted plan and its file; any other is shown when it is verified."""
        if outcome.plan.status is Status.INTERRUPTED and outcome.kept.path:
            solution = outcome.solution
            plan_view.show_plan(
                self._console, outcome.plan.mission, solution, None, solution.warnings
            )
            show_written(self._console, outcome.kept.path)

    def verified(self, outcome: PlanOutcome, request: PlanRequest | None) -> tuple[str, ...]:
        """Show the verification and the files, and find and show advice on a plan that failed."""
        spent_s = process_time() - self._began_s
        console, mission, path = self._console, outcome.plan.mission, outcome.kept.path
        assert outcome.verification is not None
        diagnosed = request is not None and not outcome.verification.ok
        assert path is not None
        plan_view.show_plan(
            console,
            mission,
            outcome.solution,
            outcome.verification,
            mission.warnings,
            advised=diagnosed,
            verbose=self._verbose,
        )
        for old in outcome.kept.aside:
            show_line(console, f"set aside because it belongs to another plan: {old}")
        if path.name == UNVERIFIED:
            show_line(console, f"kept, as it is verified: {path.with_name(FILE_NAME)}")
        show_written(console, path)
        if request is None:
            return ()
        if diagnosed:
            with plan_view.live_line(console) as show:
                diagnosis = diagnose(outcome.plan, request, spent_s, show, outcome.verification)
            advised = bool(diagnosis.remedies)
            lines = advice_on(diagnosis, outcome.plan, self._instead, path)
            if outcome.plan.status is Status.CONVERGED:
                lines = (*causes(mission, outcome.verification), *lines)
        else:
            lines = saving(outcome, request, spent_s, self._instead)
            advised = bool(lines)
        if self.found is not None and advised:
            lines = (*lines, f"these options are for solve --scenario {self.found}")
        for line in lines:
            show_line(console, line)
        return lines

    def answer(self, outcome: PlanOutcome) -> Answer:
        """The exit status and the document of a plan."""
        status, verification = outcome.plan.status, outcome.verification
        code = status.value.exit_code
        if not code and verification is not None and not verification.ok:
            code = NOT_VERIFIED
        assert outcome.kept.path is not None
        self._status = code
        return Answer(code, plan_document(outcome.solution, [outcome.kept.path]))


def advice_on(
    diagnosis: Diagnosis, failed: Plan, more: Sequence[str] = (), file: Path = Path(FILE_NAME)
) -> tuple[str, ...]:
    """Lines on what binds, on options that were tried and work, and on what did not.

    Args:
        diagnosis: of the plan.
        failed: the plan.
        more: options that undo those of the command that exclude exact risk.
        file: of the plan.
    """
    risk, found = failed.mission.scenario.risk, diagnosis
    lines = []
    if failed.status is Status.INFEASIBLE:
        lines.append(what_binds(found))
        if found.without_uncertainty is Status.INFEASIBLE or failed.final.problem == "P3":
            word = "not asked for"
            if found.without_uncertainty is Status.INFEASIBLE:
                word = "no lower probability helps"
            lines.append(f"without uncertainty it is infeasible too: {word}")
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
    verified = outcome.verification is not None and outcome.verification.ok
    cost = cost_of_exact_risk(outcome.plan, request, spent_s) if verified else None
    if cost is None:
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


def what_binds(diagnosis: Diagnosis) -> str:
    """One line on what suffices if it is relaxed alone."""
    binds = ", ".join(one.name for one in diagnosis.remedies) or "nothing that suffices alone"
    several = "; relaxing any one of them suffices" if len(diagnosis.remedies) > 1 else ""
    return f"what binds: {binds}{several}"


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
