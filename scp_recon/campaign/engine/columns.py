"""Columns of a study's rows, and what of a plan goes into them."""

from __future__ import annotations

from typing import Any

from scp_recon.campaign.study.study import Do
from scp_recon.monte_carlo.flights import FlightConfig, fly_many
from scp_recon.monte_carlo.observation_time import ALL
from scp_recon.monte_carlo.summarise import summarise
from scp_recon.monte_carlo.summary import Summary
from scp_recon.monte_carlo.verdict import shortfalls
from scp_recon.planning.plan import Plan
from scp_recon.planning.stage import Stage
from scp_recon.solution.file import Solution
from scp_recon.solution.from_plan import FINAL_STATE
from scp_recon.solution.verdict import Verification

VERIFIED = "verified"
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
        "least_charge": summary.least_charge,
        "miss_position_m": summary.terminal_miss.position_m,
        "miss_velocity_m_s": summary.terminal_miss.velocity_m_s,
        "simulated_shortfalls": "; ".join(of_simulation(summary, solution)) or None,
        "warnings": strange or None,
    }
