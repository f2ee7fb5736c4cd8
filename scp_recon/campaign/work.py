"""What a campaign does with a case of a study, and the row that comes of it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from scp_recon.campaign.case import Case, Found, solution_name
from scp_recon.campaign.changes import changed
from scp_recon.campaign.checks import check_do
from scp_recon.campaign.study import Do, Study
from scp_recon.certification.certify import certify
from scp_recon.cli.design_tables import why_nothing
from scp_recon.mission.mission import Mission
from scp_recon.monte_carlo.flights import FlightConfig, fly_many
from scp_recon.monte_carlo.observation_time import ALL
from scp_recon.monte_carlo.summary import Summary, summarise
from scp_recon.monte_carlo.verdict import shortfalls
from scp_recon.pass_design.design import Designer
from scp_recon.pass_design.setting import settled
from scp_recon.planning.initial_guess import cold, from_burns
from scp_recon.planning.plan import Plan, Stage
from scp_recon.planning.planner import plan
from scp_recon.scenario.schema import Scenario
from scp_recon.scp.status import Status
from scp_recon.solution.file import Solution
from scp_recon.solution.from_plan import FINAL_STATE, make_solution
from scp_recon.solution.verdict import Verification
from scp_recon.verification.reintegration import verify

VERIFIED = "verified"
FACET_ROUNDS = 3
"""Of a design's plan, as `python -m scp_recon.design` makes it."""

FIXED: dict[str, type] = {
    "status": str,
    "verdict": str,
    "total_dv_m_s": float,
    "probability": float,
    "probability_of": str,
    "asked": float,
    "binds": str,
    "iterations": int,
    "plan_hash": str,
    "warnings": str,
    "message": str,
}
"""Columns of every study. The probability is the lowest of the joint constraints, of nonlinear flights;
`binds` is the limit that an infeasible plan breaks most."""
OWN: dict[Do, dict[str, type]] = {
    "plan": {},
    "design": {
        "departure_tdb": str,
        "duration_s": float,
        "burns": int,
    },
    "certify": {"certified": float, "certified_low": float, "aim": float, "rounds": int},
    "fly": {
        "flights": int,
        "flown_lowest": float,
        "flown_lowest_of": str,
        "flown_whole": float,
        "flown_whole_low": float,
        "flown_whole_high": float,
        "flown_shortfalls": str,
    },
    "simulate": {
        "least_charge": float,
        "miss_position_m": float,
        "miss_velocity_m_s": float,
        "simulated_shortfalls": str,
    },
}
"""Columns of what is done."""


def work_of(study: Study) -> StudyWork:
    """What the cases of a study come to.

    Raises:
        InputError: if the extra is missing that it needs.
    """
    if study.campaign.do == "simulate":
        from scp_recon.spacecraft.basilisk.optional import needing_basilisk

        with needing_basilisk("campaign.do"):
            import scp_recon.spacecraft.basilisk.simulation  # noqa: F401
    given = study.campaign
    return StudyWork(
        study.base, study.folder.absolute(), given.do, given.samples, given.keep_solutions
    )


@dataclass(frozen=True)
class StudyWork:
    """Does the same with each case: see `case.Work`.

    Attributes:
        base: scenario that the cases change.
        folder: to which files are relative that they name.
        do: what is done.
        samples: flights with "fly".
        keep: whether solutions are kept.
    """

    base: Scenario
    folder: Path
    do: Do
    samples: int
    keep: bool

    @property
    def columns(self) -> Mapping[str, type]:
        """Of its rows."""
        return FIXED | OWN[self.do]

    def __call__(self, case: Case, /) -> Found:
        """Plan, verify, and what else is to be done.

        Raises:
            InputError: if the case is no mission.
            KeyboardInterrupt: if the plan was interrupted.
        """
        scenario = changed(self.base, case.changes, self.folder)
        row: dict[str, Any] = {"asked": scenario.risk.p_chance}
        check_do(self.do, scenario)
        if self.do == "design":
            found, own = designed(scenario)
            row |= own
            if found is None:
                return Found(row)
        else:
            found = planned(scenario, certified=self.do == "certify")
        if found.status is Status.INTERRUPTED:
            raise KeyboardInterrupt
        solution = make_solution(found)
        verification = verify(found.mission, solution)
        solution = solution.model_copy(update={"verification": verification})
        row |= planned_row(solution, verification)
        if found.status is not Status.CONVERGED:
            row["binds"] = binding(found.final)
        if self.do == "certify":
            row |= certified_row(found)
        elif self.do == "fly" and found.status is Status.CONVERGED:
            row |= flown_row(found, solution, self.samples, case.seed)
        elif self.do == "simulate" and found.status is Status.CONVERGED:
            row |= simulated_row(solution, case.seed)
        files = {solution_name(case.number): solution.text().encode()} if self.keep else {}
        return Found(row, files)


def planned(scenario: Scenario, *, certified: bool) -> Plan:
    """A scenario's plan from a straight line."""
    mission = Mission.from_scenario(scenario)
    if certified:
        return certify(mission, cold(mission), lambda m, s, aim: plan(m, s, aim=aim, init="cold"))
    return plan(mission, cold(mission), init="cold")


def designed(scenario: Scenario) -> tuple[Plan | None, dict[str, Any]]:
    """The plan of the cheapest pass from the home orbit, with what is known of the pass.

    Where no pass has a plan, there is what stopped the one that came furthest.
    """
    designer = Designer(scenario, lambda _: None)
    space, found = designer.run()
    if not found.converged:
        return None, {
            "status": Status.INFEASIBLE.value.name,
            "binds": binding(found.stage),
            "message": why_nothing(found, len(designer.tried)),
        }
    fixed = settled(scenario, space, found.at)
    mission = Mission.from_scenario(fixed)
    rounds = 0 if fixed.risk.allocation == "exact" else FACET_ROUNDS
    start = from_burns(mission, found.burns_m_s, "design")
    own = {
        "departure_tdb": fixed.epoch.tdb.isoformat(),
        "duration_s": fixed.duration_s,
        "burns": len(fixed.burns.times_s),
    }
    return plan(mission, start, facet_rounds=rounds, init="design"), own


def binding(stage: Stage) -> str:
    """The limit that is broken most, in the units of the problem; the final state where none is."""
    least = {name: float(margins.margin.min()) for name, margins in stage.margins.items()}
    name = min(least, key=least.__getitem__)
    return name if least[name] < 0.0 else FINAL_STATE


def planned_row(solution: Solution, verification: Verification) -> dict[str, Any]:
    """What a plan is worth."""
    lowest = min(verification.probabilities, key=lambda p: p.estimate, default=None)
    failed = ", ".join(verification.failed)
    return {
        "status": solution.status,
        "verdict": VERIFIED if verification.ok else f"not verified: {failed}",
        "total_dv_m_s": solution.total_dv_m_s,
        "probability": None if lowest is None else lowest.estimate,
        "probability_of": None if lowest is None else lowest.name,
        "iterations": len(solution.iterations),
        "plan_hash": solution.plan_hash,
        "warnings": "; ".join(map(str, solution.warnings)) or None,
        "message": solution.message,
    }


def certified_row(found: Plan) -> dict[str, Any]:
    """What flights reached."""
    reached = found.certificate
    if reached is None:
        return {"aim": found.aim}
    return {
        "certified": reached.reached,
        "certified_low": reached.low,
        "aim": found.aim,
        "rounds": reached.rounds,
    }


def flown_row(found: Plan, solution: Solution, samples: int, seed: int) -> dict[str, Any]:
    """What many flights found."""
    flown = fly_many(FlightConfig(found.mission, found.burns_m_s, seed), samples=samples)
    summary: Summary = summarise(flown, solution)
    joint = {name: found for name, found in summary.probability.items() if name != ALL}
    joint = {name: found for name, found in summary.probability.items() if name != ALL}
    name, lowest = min(joint.items(), key=lambda item: item[1].estimate.value, default=(None, None))
    whole = summary.whole_flight
    return {
        "flights": samples,
        "flown_lowest": None if lowest is None else lowest.value,
        "flown_lowest_of": name,
        "flown_whole": None if whole is None else whole.value,
        "flown_whole_low": None if whole is None else whole.low,
        "flown_whole_high": None if whole is None else whole.high,
        "flown_shortfalls": "; ".join(shortfalls(summary, solution)) or None,
    }


def simulated_row(solution: Solution, seed: int) -> dict[str, Any]:
    """How the spacecraft in the loop flew it."""
    from scp_recon.spacecraft.basilisk.simulation import simulate
    from scp_recon.spacecraft.record import make_record
    from scp_recon.spacecraft.vehicle import load_vehicle
    from scp_recon.spacecraft.verdict import check_vehicle
    from scp_recon.spacecraft.verdict import shortfalls as of_simulation

    vehicle = load_vehicle(None)
    flight = simulate(solution, vehicle, seed)
    summary = make_record(flight, solution, seed).summary
    strange = "; ".join(map(str, [*solution.warnings, *check_vehicle(vehicle, solution.scenario)]))
    return {
        "least_charge": summary["least_charge"],
        "miss_position_m": summary["terminal_miss"]["position_m"],
        "miss_velocity_m_s": summary["terminal_miss"]["velocity_m_s"],
        "simulated_shortfalls": "; ".join(of_simulation(summary, solution)) or None,
        "warnings": strange or None,
    }
