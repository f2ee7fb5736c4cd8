"""Run campaigns: plan, design, certify, replan, fly or simulate each case of a study."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from scp_recon.api.designing import find_pass, options_for, request_of
from scp_recon.api.flying import Flights, FlyOptions, simulation_of
from scp_recon.api.inputs import PlanRequest
from scp_recon.api.options import PlanOptions
from scp_recon.api.planning import PlanOutcome, carry_out, plan_left
from scp_recon.campaigns.axes import Case, changed, of_campaign, solution_name
from scp_recon.campaigns.run import Observer, executor_of, run_study
from scp_recon.campaigns.study import Campaign, Study, check_do
from scp_recon.errors import imported
from scp_recon.jobs.cluster import check_workers
from scp_recon.jobs.store import Row
from scp_recon.monte_carlo.limits import ALL
from scp_recon.monte_carlo.sampling import PolicyKind
from scp_recon.planning.plan import Plan, Stage
from scp_recon.replanning.flown import FlownPlan, predict
from scp_recon.replanning.remainder import Delivery
from scp_recon.results.figures import FINAL_STATE
from scp_recon.results.policy import sigmas
from scp_recon.results.solution import Solution
from scp_recon.results.verification import Verification
from scp_recon.scenario.schema import Scenario
from scp_recon.scp.status import Status
from scp_recon.verification.causes import shortfalls

if TYPE_CHECKING:
    import pandas
    from plotly.graph_objects import Figure


class CampaignOutput(NamedTuple):
    """Results of `campaign`.

    Attributes:
        table: a row a case, as in results.parquet.
        figures: the page's charts by name, of Plotly: maps and the shape of sites, else curves.
    """

    table: pandas.DataFrame
    figures: dict[str, Figure]


def run_campaign(
    study: Study,
    folder: Path,
    *,
    workers: int | None = None,
    scheduler: str | None = None,
    observe: Observer | None = None,
    say: Callable[[str], None] = lambda _: None,
) -> Path:
    """Run the cases of a study that have no row in a folder yet; returns the file `results.parquet`.

    `workers` are processes, one by default, 0 for this one; `observe` is called after each row, `say`
    with each line worth showing.
    """
    workers = check_workers(workers, scheduler, 0)
    executor = executor_of(study, 1 if workers is None else workers, scheduler, say)
    return run_study(study, folder, work_of(study), executor, observe)


def work_of(study: Study) -> StudyWork:
    """Make the work of a study's cases."""
    if study.campaign.do == "simulate":
        imported("campaign.do", "sim", "Basilisk")
    return StudyWork(study.base, study.folder.absolute(), study.campaign)


@dataclass(frozen=True)
class StudyWork:
    """Plans a case, and does what else its campaign says: a `run.CaseWork`.

    Cases change the base; files that they name are relative to the folder.
    """

    base: Scenario
    folder: Path
    campaign: Campaign

    def __call__(self, case: Case, /) -> Row:
        """Plan and verify a case, and fly or simulate it if the campaign says so."""
        do, scenario = self.campaign.do, changed(self.base, case.changes, self.folder)
        row: dict[str, Any] = {"asked": scenario.risk.p_chance}
        check_do(do, scenario)
        if do == "design":
            outcome, own = designed(scenario)
            row |= own
            if outcome is None:
                return Row(row)
        else:
            outcome = planned(scenario, certify=do == "certify")
        found, solution = outcome.plan, outcome.solution
        if outcome.verification is None:
            raise KeyboardInterrupt
        row |= planned_row(solution, outcome.verification)
        if found.status is not Status.CONVERGED:
            row["binds"] = binding(found.final)
        if do == "certify":
            row |= certified_row(found)
        elif found.status is not Status.CONVERGED:
            pass  # what else there is to do needs a plan
        elif do == "replan":
            row |= rest_row(found, self.campaign.model_copy(update=of_campaign(case.changes)))
        elif do == "fly":
            options = FlyOptions(self.campaign.samples, seed=case.seed, policy=self.campaign.policy)
            row |= flown_row(solution, options)
        elif do == "simulate":
            row |= simulated_row(solution, case.seed, self.campaign.policy)
        files = {}
        if self.campaign.keep_solutions:
            files[solution_name(case.number)] = solution.text().encode()
        return Row(row, files)


def planned(scenario: Scenario, *, certify: bool) -> PlanOutcome:
    """Plan and verify a scenario from a straight line; certify on request only."""
    return carry_out(PlanRequest(scenario, options=PlanOptions(certify=certify)))


def designed(scenario: Scenario) -> tuple[PlanOutcome | None, dict[str, Any]]:
    """Plan and verify the cheapest pass from the home orbit; return the plan and columns on the pass.

    If no pass has a plan, the columns say what stopped the pass that came furthest.
    """
    options, found = options_for(scenario, certify=False), find_pass(scenario)
    if found.scenario is None:
        return None, {
            "status": Status.INFEASIBLE.value.name,
            "binds": binding(found.best.stage),
            "message": found.message,
        }
    return carry_out(request_of(found, options)), {
        "departure_tdb": found.scenario.epoch.tdb.isoformat(),
        "duration_s": found.scenario.duration_s,
        "burns": len(found.scenario.burns.times_s),
    }


def binding(stage: Stage) -> str:
    """The limit violated most, in the problem's units; the final state if none is violated."""
    least = {name: float(margins.margin.min()) for name, margins in stage.margins.items()}
    name = min(least, key=least.__getitem__)
    return name if least[name] < 0.0 else FINAL_STATE


def planned_row(solution: Solution, verification: Verification) -> dict[str, Any]:
    """Columns of a plan and its verification."""
    lowest = min(verification.probabilities, key=lambda p: p.estimate, default=None)
    return {
        "status": solution.status,
        "verdict": verification.verdict,
        "total_dv_m_s": solution.total_dv_m_s,
        "dv99_m_s": solution.policy.dv99_m_s if solution.policy else solution.total_dv_m_s,
        "final_sigma_m": sigmas(np.array(solution.nodes.covariance[-1]))[0],
        "probability": None if lowest is None else lowest.estimate,
        "probability_of": None if lowest is None else lowest.name,
        "iterations": len(solution.iterations),
        "plan_hash": solution.plan_hash,
        "warnings": "; ".join(map(str, solution.warnings)) or None,
        "message": solution.message,
    }


def rest_row(found: Plan, campaign: Campaign) -> dict[str, Any]:
    """Columns of the rest of a flight, planned again from its planned state; cost of the rest alone."""
    flown = FlownPlan.of(found)
    delivery = Delivery.of(campaign.at_s, predict(flown, campaign.at_s, {}).state)
    rest = plan_left(flown, delivery, free_times=campaign.free_times)
    return {
        "rest_status": rest.status.value.name,
        "rest_dv_m_s": rest.total_dv_m_s,
        "rest_times_s": " ".join(f"{time:.1f}" for time in rest.mission.scenario.burn_times_s),
    }


def certified_row(found: Plan) -> dict[str, Any]:
    """Columns of a certificate."""
    row: dict[str, Any] = {"target": found.target}
    if (one := found.certificate) is not None:
        row |= {"certified": one.reached, "certified_low": one.low, "rounds": one.rounds}
    return row


def flown_row(solution: Solution, options: FlyOptions) -> dict[str, Any]:
    """Columns of many flights."""
    summary = Flights.of(solution, options).summary()
    joint = {name: found for name, found in summary.probability.items() if name != ALL}
    name, lowest = min(joint.items(), key=lambda item: item[1].estimate.value, default=(None, None))
    whole, commanded = summary.whole_flight, summary.commanded
    return {
        "flights": options.samples,
        "flown_lowest": None if lowest is None else lowest.value,
        "flown_lowest_of": name,
        "flown_whole": whole.value,
        "flown_whole_low": whole.low,
        "flown_whole_high": whole.high,
        "flown_dv99_m_s": commanded.dv99_m_s.value if commanded else solution.total_dv_m_s,
        "flown_final_sigma_m": summary.terminal.sigma_position_m.value,
        "flown_shortfalls": "; ".join(shortfalls(summary, solution)) or None,
    }


def simulated_row(solution: Solution, seed: int, policy: PolicyKind | None) -> dict[str, Any]:
    """Columns of a simulated flight."""
    from scp_recon.simulation.vehicle import check_vehicle

    simulation = simulation_of(solution, seed, policy, None)
    summary, doubts = simulation.fly().summary, check_vehicle(simulation.craft, solution.scenario)
    strange = "; ".join(map(str, [*solution.warnings, *doubts]))
    return {
        "least_charge": summary.least_charge,
        "miss_position_m": summary.terminal_miss.position_m,
        "miss_velocity_m_s": summary.terminal_miss.velocity_m_s,
        "simulated_shortfalls": "; ".join(shortfalls(summary, solution)) or None,
        "warnings": strange or None,
    }
