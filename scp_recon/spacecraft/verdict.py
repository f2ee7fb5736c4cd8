"""Whether a simulated flight kept what was asked of the spacecraft."""

from __future__ import annotations

from collections.abc import Iterator

from scp_recon.scenario.schema import Scenario
from scp_recon.scenario.warning import ScenarioWarning
from scp_recon.scp.status import Status
from scp_recon.solution.file import Solution
from scp_recon.spacecraft.summary import FlightSummary
from scp_recon.spacecraft.vehicle import Vehicle

SHORT_WH = 1e-9
"""Energy that counts as none."""
SAME_MASS = 0.05
"""How far the vehicle's mass may be off the plan's, relative; the plan burns nothing."""


def check_vehicle(vehicle: Vehicle, scenario: Scenario) -> Iterator[ScenarioWarning]:
    """Whether the vehicle that is flown is the spacecraft that was planned for."""
    planned, flown = scenario.spacecraft.mass_kg, vehicle.mass.mass_kg
    if abs(flown - planned) > SAME_MASS * planned:
        yield ScenarioWarning.of(
            "spacecraft.mass_kg",
            f"{planned:g} kg",
            f"{vehicle.name}, the vehicle that is flown, has {flown:g} kg: give your own by --vehicle",
        )


def shortfalls(summary: FlightSummary, solution: Solution) -> list[str]:
    """What was not kept, each beside what was asked; empty if all was.

    Asked are a plan that converged, a charge above the vehicle's floor with every load served, and of
    every mode the length and the steady attitude that the schedule's rules give it.

    Args:
        summary: of a simulation file.
        solution: whose plan was flown.
    """
    converged = Status.CONVERGED.value.name
    found = []
    if solution.status != converged:
        found.append(f"the plan is {solution.status}, asked {converged}")
    charge, floor = summary.least_charge, summary.floor_charge
    if charge < floor:
        found.append(f"least state of charge {charge:.3f}, asked {floor:.2f}")
    if (short := summary.energy_wh.short) > SHORT_WH:
        found.append(f"{short:.3g} Wh short, asked 0")
    rule = solution.scenario.schedule.attitude_s
    for leg in summary.legs:
        name = f"{leg.mode} mode from {leg.start_s:.0f} s"
        if not leg.ok:
            found.append(f"{name} {leg.duration_s:.0f} s long, asked {leg.required_s:.0f} s")
        if not leg.settled_in_time:
            after = "never" if leg.settled_s is None else f"after {leg.settled_s:.0f} s"
            found.append(f"{name} steady {after}, asked {rule:.0f} s")
    return found
