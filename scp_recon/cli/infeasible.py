"""What to ask instead of what is infeasible: the largest probability that has a plan, and its price."""

from __future__ import annotations

from rich.console import Console

from formulations.problem.flyby import Iterate
from scp_recon.certification.largest import LEAST, largest_probability, rounded_down
from scp_recon.cli.command import show_line
from scp_recon.mission.mission import Mission
from scp_recon.planning.plan import Plan
from scp_recon.planning.planner import plan
from scp_recon.scp.status import Status

CLOSE = 0.1
"""Standard deviations to which the largest probability is found: a hint, in a few plans."""


def show_what_would_do(console: Console, failed: Plan) -> None:
    """Say what binds, and the options of a plan that is feasible.

    What keeps the limits without uncertainty is a matter of the probability asked: with exact risk the
    largest that has a plan is looked for. Where not even the mean keeps them, no probability helps.
    """
    names = [name for name, (margin, _) in failed.worst_margins.items() if margin < 0.0]
    binds = ", ".join(names) or "the final state"
    solved = [s for s in failed.stages if s.result.status is Status.CONVERGED]
    p3 = next((s for s in solved if s.problem == "P3"), None)
    if p3 is None:
        show_line(
            console,
            f"what binds: {binds}; also without uncertainty: the limits, the final state or the size "
            "of the burns have to give way, and no lower probability helps",
        )
        return
    risk = failed.mission.scenario.risk
    show_line(console, f"what binds: {binds}; without uncertainty all limits hold")
    exact = failed.mission.scenario.replace({"risk.allocation": "exact"})
    mission = Mission.from_scenario(exact)

    def tried(mission: Mission, start: Iterate, aim: float) -> Plan:
        return plan(mission, start, aim=aim)

    best = largest_probability(mission, p3.result.lin.iterate, tried, close=CLOSE)
    if best.status is not Status.CONVERGED or best.aim is None:
        show_line(console, f"with exact risk there is no plan for a probability of {LEAST} either")
        return
    asked = rounded_down(best.aim)
    if asked >= risk.p_chance:
        asked = risk.p_chance
        word = "exact risk solves what the uniform split over polytopes cannot"
    else:
        cost = best.total_dv_m_s
        word = f"the largest probability with a plan is about {asked:g}, for {cost:.4f} m/s"
    show_line(
        console,
        f"{word}: --set 'risk.allocation=\"exact\"' --set risk.p_chance={asked:g} --certify no",
    )
