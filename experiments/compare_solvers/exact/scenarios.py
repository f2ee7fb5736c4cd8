"""The scenarios of exact risk: variations of the default one drawn from seeds, and who solves them."""

from __future__ import annotations

import json
from typing import Any, Literal

import numpy as np

from experiments.compare_solvers.cases import EXACT, REFERENCE, Cell, Method

NUMBER = 50
"""Scenarios, every other one for whole flights."""

QUICK = range(2)
"""Seeds of a quick run: one scenario of each kind."""

SLSQP, SHOOTING_IPOPT = Method("burns", "exact", "SLSQP"), Method("burns", "exact", "IPOPT")
"""Nonlinear programming in the burns: see `exact.search`."""

PRINTED = {
    "initial_position_m": (70.2, -1096.3, 406.4),
    "initial_velocity_m_s": (-0.0047, -0.0167, 0.0278),
    "final_position_m": (19.9, 1128.7, -140.9),
    "final_velocity_m_s": (0.0003, 0.0496, -0.0457),
}
OFF_M, OFF_M_S = 20.0, 1e-3
"""1 sigma by which each component of a boundary state is off the printed one."""

Changes = dict[str, Any]


def drawn(seed: int) -> tuple[str, Changes]:
    """A scenario by name, and its changes to the default one; odd seeds ask for whole flights."""
    rng = np.random.default_rng([20200121, seed])
    scope: Literal["node", "flight"] = "flight" if seed % 2 else "node"
    risk: Changes = {
        "risk.allocation": "exact",
        "risk.scope": scope,
        "risk.p_chance": round(float(rng.uniform(0.55, 0.99)), 3),
    }
    return f"{scope} {seed:02d}", risk | _errors(rng) | _boundary(rng) | _limits(rng)


def _errors(rng: np.random.Generator) -> Changes:
    """Of the burns by either model, of the initial state by either form."""

    def between(low: float, high: float) -> float:
        return float(f"{rng.uniform(low, high):.4g}")

    found: Changes = {}
    if rng.random() < 0.5:
        found["uncertainty.execution_error"] = between(0.01, 0.1)
    else:
        gates = {
            "magnitude_fixed_m_s": between(0.0, 5e-4),
            "magnitude_proportional": between(0.005, 0.07),
            "pointing_fixed_m_s": between(0.0, 5e-4),
            "pointing_proportional_rad": between(0.005, 0.06),
            "magnitude_bias": between(0.0, 0.03) if rng.random() < 0.5 else 0.0,
        }
        found |= {f"uncertainty.gates.{key}": value for key, value in gates.items()}
    if rng.random() < 0.5:
        found["uncertainty.initial_sigma_fraction"] = between(0.002, 0.015)
    else:
        found["uncertainty.initial_frame"] = "rtn"
        found["uncertainty.initial_sigma_position_m"] = [between(1.0, 15.0) for _ in range(3)]
        found["uncertainty.initial_sigma_velocity_m_s"] = [between(5e-5, 5e-4) for _ in range(3)]
    return found


def _boundary(rng: np.random.Generator) -> Changes:
    found: Changes = {}
    for name, values in PRINTED.items():
        off = rng.normal(scale=OFF_M if name.endswith("_m") else OFF_M_S, size=3)
        found[f"boundary.{name}"] = np.round(np.add(values, off), 6).tolist()
    return found


def _limits(rng: np.random.Generator) -> Changes:
    def between(low: float, high: float) -> float:
        return round(float(rng.uniform(low, high)), 2)

    return {
        "observation.site_distance_min_m": between(450.0, 520.0),
        "observation.site_distance_max_m": between(710.0, 800.0),
        "observation.emission_min_deg": between(12.0, 22.0),
        "observation.emission_max_deg": between(42.0, 55.0),
        "observation.phase_min_deg": between(5.0, 20.0),
        "observation.phase_max_deg": between(70.0, 89.0),
        "battery.observation_cone_deg": between(12.0, 22.0),
        "battery.delta_v_cone_deg": between(15.0, 30.0),
        "safety.radius_min_m": between(480.0, 560.0),
    }


def exact_design(scenarios: range = range(NUMBER)) -> tuple[Cell, ...]:
    """The planner from the straight line, and both references."""
    return tuple(cell for seed in scenarios for cell in _cells(*drawn(seed)))


def _cells(name: str, changes: Changes) -> list[Cell]:
    # What JSON says of numbers, lists and text says TOML alike.
    overrides = tuple(f"{entry}={json.dumps(value)}" for entry, value in changes.items())
    methods = (REFERENCE, SLSQP, SHOOTING_IPOPT)
    return [Cell(EXACT, name, overrides, method, "cold") for method in methods]
