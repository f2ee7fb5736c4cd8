"""The plan that was flown before this one was made in flight, as the file names it."""

from __future__ import annotations

from scp_recon.errors import InputError
from scp_recon.scenario.fields import Line
from scp_recon.scenario.schema import Scenario
from scp_recon.solution.part import Part


class ParentPlan(Part):
    """A plan by its name and by its hash, and the time of the state from which the new one was made."""

    name: Line
    plan_hash: Line
    at_s: float


def require_whole_flight(scenario: Scenario, entry: str) -> None:
    """Refuse a plan that begins in flight where only a whole one serves.

    Raises:
        InputError: if it does.
    """
    if scenario.in_flight is not None:
        raise InputError(
            entry,
            f"a plan from {scenario.start_s:g} s on, made in flight",
            "must be the plan of a whole flight",
        )
