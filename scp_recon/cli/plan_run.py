"""Show a plan on its way into the folder of a run; for an infeasible plan show feasible options."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import AbstractContextManager, ExitStack, contextmanager, nullcontext
from pathlib import Path
from typing import Self

from rich.console import Console

from formulations.problem.flyby import Iterate
from formulations.registry import FULL
from scp_recon.api.infeasibility import SIZE, Diagnosis, diagnose
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
from scp_recon.cli.rendering import show_warnings
from scp_recon.mission.mission import Mission
from scp_recon.planning.plan import Plan
from scp_recon.results.solution import FILE_NAME
from scp_recon.scenario.schema import Scenario
from scp_recon.scp.status import Status


def show_largest(budget_m_s: float | None, plan: Plan, console: Console) -> None:
    """Show the largest probability, with its delta-v and the budget."""
    most = "any delta-v" if budget_m_s is None else f"at most {budget_m_s:g} m/s"
    result = f"{plan.mission.scenario.risk.p_chance:.5g}, for {plan.cost_m_s:.6f} m/s"
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
    """

    def __init__(self, console: Console, out: Path | None, instead: Sequence[str] = ()) -> None:
        self._console, self._out, self._instead = console, out, instead
        self._open = ExitStack()
        self._status: int | None = None
        self._folder: Path | None = None

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
        plan_view.show_mission(self._console, mission)
        self._console.print()
        with live_progress(self._console, mission) as observe:
            yield observe

    def planned(self, outcome: PlanOutcome) -> None:
        """Show the plan; if it was interrupted, its file too."""
        plan_view.show_solution(self._console, outcome.solution)
        if outcome.plan.status is Status.INTERRUPTED and outcome.kept.path:
            show_warnings(self._console, outcome.solution.warnings)
            show_written(self._console, outcome.kept.path)

    def verified(self, outcome: PlanOutcome, start: Iterate | None) -> tuple[str, ...]:
        """Show the verification and the files, and find and show advice on an infeasible plan."""
        console, mission, path = self._console, outcome.plan.mission, outcome.kept.path
        assert outcome.verification is not None
        assert path is not None
        plan_view.show_verification(
            console, mission, outcome.solution, outcome.verification, mission.warnings
        )
        for old in outcome.kept.aside:
            show_line(console, f"set aside because it belongs to another plan: {old}")
        if path.name == UNVERIFIED:
            show_line(console, f"kept, as it is verified: {path.with_name(FILE_NAME)}")
        show_written(console, path)
        if outcome.plan.status is not Status.INFEASIBLE:
            return ()
        lines = advice_on(outcome.plan, start, self._instead)
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


SEVERAL = "; relaxing any one of them suffices"
NO_SINGLE = (
    "relaxing one of these alone does not suffice: the burns' size, the burns' directions, "
    "the final state, the limits"
)


def advice_on(
    failed: Plan, start: Iterate | None = None, more: Sequence[str] = ()
) -> tuple[str, ...]:
    """Lines on the limits that bind, and on options for a feasible plan.

    Args:
        failed: the infeasible plan.
        start: where it began.
        more: options that undo those of the command that exclude exact risk.
    """
    diagnosis = diagnose(failed, start)
    return what_binds(diagnosis), *what_would_do(diagnosis, failed, more)


def undoing(options: PlanOptions) -> list[str]:
    """Options that, added to those of a command, allow exact risk and a given probability."""
    undone = []
    kept = ("method", ("scp",)), ("formulation", FULL), ("facet-rounds", (0,))
    for name, those in kept:
        if getattr(options, name.replace("-", "_")) not in (*those, None):
            undone += [f"--{name}", str(those[0])]
    if options.objective != "delta-v":
        undone += ["--objective", "delta-v"]
    if options.dv_budget_m_s is not None:
        undone += ["--dv-budget", "any"]
    return undone


def what_binds(diagnosis: Diagnosis) -> str:
    """One line on the limits of which relaxing any one suffices, and on violated constraints."""
    names = ", ".join(diagnosis.violated) or "none"
    if not diagnosis.binds:
        return f"what binds: {NO_SINGLE}; violated: {names}"
    words = [
        f"{name} (up to {diagnosis.burn_m_s:.4f} m/s would do)" if name == SIZE else name
        for name in diagnosis.binds
    ]
    line = f"what binds: {', '.join(words)}"
    return f"{line}{SEVERAL if len(words) > 1 else ''}; violated: {names}"


def what_would_do(diagnosis: Diagnosis, failed: Plan, more: Sequence[str]) -> list[str]:
    """Lines on exact risk: a plan as required, the largest feasible probability, and options."""
    without = diagnosis.without_uncertainty
    if without is Status.INFEASIBLE or failed.final.problem == "P3":
        word = "no lower probability helps" if without is Status.INFEASIBLE else "not asked for"
        return [f"without uncertainty it is infeasible too: {word}"]
    lines = []
    risk, largest = failed.mission.scenario.risk, diagnosis.largest
    what = "whole flights" if risk.scope == "flight" else "each constraint at each node"
    if diagnosis.exact is not None:
        cost = f"{diagnosis.exact.cost_m_s:.4f} m/s"
        if risk.allocation == "uniform":
            word = f"exact risk solves what the uniform split cannot: {risk.p_chance} for {cost}"
        else:
            p = f"{diagnosis.exact.target}"
            word = f"{p} has a plan under the normal law, for {cost}, but none that flights certify"
        lines.append(word)
    if largest is None or largest.target is None:
        lines.append("no probability of more than one half was found to have a plan")
        if without is not Status.CONVERGED:
            lines[-1] += (
                f", which shows little: without uncertainty planning ended {without.value.name}"
            )
        return lines
    lines.append(
        f"the largest probability found feasible, of {what}: {rounded_down(largest.target):g} "
        f"for {largest.cost_m_s:.4f} m/s"
    )
    if diagnosis.verified is None:
        return [*lines, "no plan with exact risk was found that passes verification"]
    required = diagnosis.verified.mission.scenario.risk.p_chance
    certify = "no" if diagnosis.verified.certificate is None else "yes"
    options = [*more, "--set 'risk.allocation=\"exact\"'", f"--set risk.p_chance={required}"]
    cost = f"{diagnosis.verified.cost_m_s:.4f} m/s"
    lines.append(f"feasible, for {cost}, with: {' '.join([*options, f'--certify {certify}'])}")
    return lines
