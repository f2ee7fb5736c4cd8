"""A home orbit that tests design from: the terminator's, about the default scenario's window."""

from typing import Any

from scp_recon.scenario.load import validate_scenario
from scp_recon.scenario.schema import Scenario

MEASURED: dict[str, object] = {
    "policy.kind": "feedback",
    "navigation.sigma_position_m": 10.0,
    "navigation.sigma_velocity_m_s": 5e-4,
}
"""Feedback by a measurement at each burn's time."""


def home_scenario(
    changes: dict[str, Any] | None = None, design: dict[str, Any] | None = None, **home: Any
) -> Scenario:
    """The default scenario from a home orbit of 1 km, with entries of either changed."""
    circle = {"radius_m": 1000.0, "normal": [1.0, 0.0, 0.0], "sense": "left_handed"}
    tables: dict[str, Any] = {
        "base": "recon_b",
        "boundary": {"home": circle | home},
        "polytopes": {"ball": "tangent", "cone": 12},
    }
    if design is not None:
        tables["design"] = design
    found = validate_scenario(tables)
    return found.replace(changes) if changes else found
