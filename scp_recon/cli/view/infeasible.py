"""What to ask instead of what is infeasible: what binds, the largest probability, and its price."""

from __future__ import annotations

import argparse
from collections.abc import Sequence

from rich.console import Console

from formulations.problem.flyby import Iterate
from scp_recon.certification.largest import rounded_down
from scp_recon.certification.way_out import SIZE, WayOut, way_out
from scp_recon.cli.command import show_line
from scp_recon.planning.method import FORMULATION
from scp_recon.planning.plan import Plan
from scp_recon.scp.status import Status

SEVERAL = "; any of them, given way to alone, would do"


def show_what_would_do(
    console: Console, failed: Plan, start: Iterate | None = None, more: Sequence[str] = ()
) -> None:
    """Say what binds, and the options of a plan that is feasible.

    Args:
        console: where to.
        failed: the infeasible plan.
        start: where it began.
        more: options that undo what the command's own ones say against exact risk.
    """
    found = way_out(failed, start)
    for line in (what_binds(found), *what_would_do(found, failed, more)):
        show_line(console, line)


def undoing(options: argparse.Namespace) -> list[str]:
    """Options after those of a command that make it one for exact risk and a probability."""
    undone = []
    for name, only in (("method", "scp"), ("formulation", FORMULATION), ("facet-rounds", 0)):
        if getattr(options, name.replace("-", "_")) not in (only, None):
            undone += [f"--{name}", str(only)]
    if options.objective != "delta-v":
        undone += ["--objective", "delta-v"]
    if options.dv_budget is not None:
        undone += ["--dv-budget", "any"]
    return undone


def what_binds(found: WayOut) -> str:
    """In one line."""
    names = ", ".join(found.violated) or "none"
    if not found.binds:
        alone = (
            "of the size and the directions of the burns, the final state and the limits none alone"
        )
        return f"what binds: {alone}; violated: {names}"
    words = [
        f"{name} (up to {found.burn_m_s:.4f} m/s would do)" if name == SIZE else name
        for name in found.binds
    ]
    line = f"what binds: {', '.join(words)}"
    return f"{line}{SEVERAL if len(words) > 1 else ''}; violated: {names}"


def what_would_do(found: WayOut, failed: Plan, more: Sequence[str]) -> list[str]:
    """Of exact risk: whether it solves what was asked, what it can at most, and the options for it."""
    without = found.without_uncertainty
    if without is Status.INFEASIBLE or failed.final.problem == "P3":
        word = "no lower probability helps" if without is Status.INFEASIBLE else "not asked for"
        return [f"without uncertainty it is infeasible too: {word}"]
    lines = []
    risk, largest = failed.mission.scenario.risk, found.largest
    what = "whole flights" if risk.scope == "flight" else "each constraint at each node"
    if found.exact is not None:
        cost = f"{found.exact.total_dv_m_s:.4f} m/s"
        if risk.allocation == "uniform":
            word = f"exact risk solves what the uniform split cannot: {risk.p_chance} for {cost}"
        else:
            p = f"{found.exact.aim}"
            word = f"{p} has a plan under the normal law, for {cost}, but none that flights certify"
        lines.append(word)
    if largest is None or largest.aim is None:
        lines.append("no probability of more than one half was found to have a plan")
        if without is not Status.CONVERGED:
            lines[-1] += (
                f", which shows little: without uncertainty planning ended {without.value.name}"
            )
        return lines
    lines.append(
        f"the largest probability found feasible, of {what}: {rounded_down(largest.aim):g} "
        f"for {largest.total_dv_m_s:.4f} m/s"
    )
    if found.verified is None:
        return [*lines, "of exact risk no plan was found that ends verified"]
    asked = found.verified.mission.scenario.risk.p_chance
    certify = "no" if found.verified.certificate is None else "yes"
    options = [*more, "--set 'risk.allocation=\"exact\"'", f"--set risk.p_chance={asked}"]
    cost = f"{found.verified.total_dv_m_s:.4f} m/s"
    lines.append(f"feasible, for {cost}, with: {' '.join([*options, f'--certify {certify}'])}")
    return lines
