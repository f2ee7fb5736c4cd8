"""What the terminal shows of certification: flights as they begin, and what they reached."""

from __future__ import annotations

from dataclasses import replace
from io import StringIO

from rich.console import Console

from scp_recon.cli.plan_view import live_progress
from scp_recon.monte_carlo.estimates import Estimate
from scp_recon.planning.plan import Plan


def test_rounds_are_told_beside_the_iterations(default_plan: Plan) -> None:
    out = StringIO()
    plan = replace(default_plan, target=0.91234)
    stage = plan.stages[0]
    with live_progress(Console(file=out, width=120), plan.mission) as seen:
        seen(stage.name, stage.result.records[0])
        seen.flights("round 1", plan, 10_000)
        seen.flights("round 1", plan, 10_000, 4_000)
        flying = [str(line) for line in seen.steps.values()]
        seen.flights("round 1", plan, 10_000, 10_000, Estimate(0.909, 0.9032, 0.9146))
        seen.flights("look 1", plan, 20_000)
    assert len(flying) == 1
    assert flying[0].endswith("10000 flights: 4000 flown")
    shown = out.getvalue()
    assert (
        shown.count("round 1: target 0.91234, 0.140135 m/s, 154 nodes; 10000 flights: 0.9090") == 1
    )
    assert "at least 0.9032" in shown
    assert shown.count("look 1:") == 1
    assert stage.name in shown
