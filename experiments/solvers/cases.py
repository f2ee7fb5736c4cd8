"""Methods, scenarios and starts of the comparison of solvers, and the cells that combine them."""

from __future__ import annotations

import json
from collections.abc import Iterable
from dataclasses import dataclass
from itertools import product
from typing import Any, Literal

import numpy as np

from formulations.program.solvers import installed
from formulations.registry import FORMULATIONS, FULL
from scp_recon.scp.algorithms import ALGORITHMS

IPOPT, UNO = "IPOPT", "UNO"
NLP_SOLVERS = (IPOPT, UNO)


@dataclass(frozen=True)
class Method:
    """A method: keys of `FORMULATIONS` and `ALGORITHMS`, and a conic solver; by default the commands'.

    For `NLP_SOLVERS` the keys are the nonlinear program's variant, and "hard", or "elastic" with SCP's
    penalty.
    """

    formulation: str = "condensed"
    algorithm: str = "scvx"
    solver: str = "CLARABEL"

    @property
    def name(self) -> str:
        """Name in the tables."""
        return f"{self.formulation}/{self.algorithm}/{self.solver}"


Start = Literal["cold", "p3", "random"]
Group = Literal["matrix", "scenarios", "guesses", "random", "exact"]
EXACT: Group = "exact"


@dataclass(frozen=True)
class Cell:
    """One run of the comparison.

    Attributes:
        group: table that it belongs to.
        scenario: name of the scenario.
        overrides: its changes to the base, as for `--set`.
        method: method that solves it.
        start: straight line; SCP's own P3 solution and the facets there, the same for every method;
            or a random guess.
        seed: of the random guess.
        base: scenario that is changed.
        repeat: number of the run, which changes nothing but times.
    """

    group: Group
    scenario: str
    overrides: tuple[str, ...]
    method: Method
    start: Start
    seed: int = 0
    base: str = "recon_b"
    repeat: int = 0

    @property
    def key(self) -> str:
        """Unique name, the same in every run of this study."""
        start = f"{self.start}{self.seed}" if self.start == "random" else self.start
        again = f"|{self.repeat}" if self.repeat else ""
        return f"{self.group}|{self.scenario}|{start}|{self.method.name}{again}"


REFERENCE, PTR, SCVX_STAR = Method(), Method(algorithm="ptr"), Method(algorithm="scvx-star")
LIFTED, FROZEN_STM = Method("lifted"), Method("frozen-stm")
FROZEN_COVARIANCE = Method("frozen-covariance")
TUNED, ELASTIC = Method("tuned", "hard", IPOPT), Method("tuned", "elastic", IPOPT)
SHOOTING, SHOOTING_UNO = (Method("shooting", "hard", solver) for solver in NLP_SOLVERS)

SCP_METHODS = tuple(Method(*key) for key in product(FORMULATIONS, ALGORITHMS, installed()))
NLP_METHODS = (Method("printed", "hard", IPOPT), TUNED, SHOOTING, SHOOTING_UNO, ELASTIC)
FEW = (REFERENCE, FROZEN_COVARIANCE, TUNED, ELASTIC)
"""Methods that plan the variations of the default scenario."""

ONE_FACTOR = (
    *(REFERENCE, PTR, SCVX_STAR, LIFTED, FROZEN_STM),
    *(Method(solver=solver) for solver in ("QOCO", "ECOS")),
    *(TUNED, SHOOTING, SHOOTING_UNO),
)
"""Methods that differ from the reference in one thing, and nonlinear programs."""

GUESSED = (
    *(REFERENCE, PTR, SCVX_STAR, FROZEN_STM, Method("lifted", solver="ECOS")),
    *(TUNED, SHOOTING, SHOOTING_UNO),
)
"""Methods started from random guesses; lifted by ECOS, its fastest solver except SCS."""


PRINTED = {
    "initial_position_m": (70.2, -1096.3, 406.4),
    "initial_velocity_m_s": (-0.0047, -0.0167, 0.0278),
    "final_position_m": (19.9, 1128.7, -140.9),
    "final_velocity_m_s": (0.0003, 0.0496, -0.0457),
}

NUMBER, GUESSES = 50, 20
"""Random scenarios, every other one for whole flights, and random guesses."""

OFF_M, OFF_M_S = 20.0, 1e-3
"""1 sigma by which each component of a boundary state is off the printed one."""

Changes = dict[str, Any]

REPEATS = 5
PROBLEMS: dict[str, tuple[str, tuple[str, ...]]] = {
    "recon_b": ("recon_b", ()),
    "nightingale": (
        "nightingale",
        (
            "boundary.home.departure_deg=[159, 159]",
            "boundary.home.arrival_deg=[0.5, 0.5]",
            "design.departure_s=[0, 0]",
            "design.arrival_s=[34842, 34842]",
            'risk.allocation="uniform"',
            'risk.scope="node"',
        ),
    ),
    "replan": (
        "recon_b",
        (
            'in_flight={at_s = 2057.143, frame = "j2000", '
            "position_m = [-113.009, -662.541, -908.545], "
            "velocity_m_s = [-0.0042329, 0.0482099, -0.0071459], "
            "flown_m_s = [[-0.009414321, 0.044802051, 0.018887179]]}",
        ),
    ),
}
"""Base and changes of the problems that every method solves: the default one; a pass from the packaged
home orbit, its phases fixed; what is left of the default plan from a state 17 m and 0.7 mm/s off it."""


def scenarios() -> dict[str, tuple[str, ...]]:
    """Overrides of the default scenario by name."""
    found: dict[str, tuple[str, ...]] = {"recon_b": ()}
    for p in (0.6, 0.8, 0.9, 0.95):
        found[f"p_chance={p:g}"] = (f"risk.p_chance={p:g}",)
    for beta in (0.02, 0.04, 0.12, 0.16):
        found[f"beta={beta:g}"] = (f"uncertainty.execution_error={beta:g}",)
    found["bold"] = ("risk.p_chance=0.95", "uncertainty.execution_error=0.16")
    found["tangent"] = ('polytopes.ball="tangent"', "polytopes.cone=12")
    found["frame=j2000"] = ('boundary.frame="j2000"',)
    for seed in range(1, 5):
        found[f"shifted {seed}"] = _overrides(_boundary(np.random.default_rng(seed)))
    return found


def full_design() -> list[Cell]:
    """All cells with uniform risk.

    Every method solves every problem from the straight line, several times; a few do elsewhere.
    """
    uniform = {"risk.allocation": "uniform", "risk.scope": "node"}
    random = {f"uniform {k:02d}": _overrides(drawn(k)[1] | uniform) for k in range(NUMBER)}
    return [
        *(
            Cell("matrix", name, overrides, method, "cold", base=base, repeat=repeat)
            for repeat in range(REPEATS)
            for name, (base, overrides) in PROBLEMS.items()
            for method in (*SCP_METHODS, *NLP_METHODS)
        ),
        *_cells("scenarios", scenarios(), FEW, "p3"),
        *(
            Cell("guesses", "recon_b", (), method, "random", seed)
            for seed, method in product(range(GUESSES), GUESSED)
        ),
        *_cells("random", random, ONE_FACTOR, "cold"),
    ]


def exact_design(seeds: range = range(NUMBER)) -> list[Cell]:
    """Random scenarios of exact risk from the straight line, by every form that takes it."""
    methods = [method for method in ONE_FACTOR if method.formulation in FULL]
    found = {name: _overrides(changes) for name, changes in map(drawn, seeds)}
    return _cells(EXACT, found, methods, "cold")


def _cells(
    group: Group, found: dict[str, tuple[str, ...]], methods: Iterable[Method], start: Start
) -> list[Cell]:
    """Every method in every scenario."""
    return [
        Cell(group, name, overrides, method, start)
        for (name, overrides), method in product(found.items(), methods)
    ]


def _overrides(changes: Changes) -> tuple[str, ...]:
    # What JSON says of numbers, lists and text says TOML alike.
    return tuple(f"{entry}={json.dumps(value)}" for entry, value in changes.items())


# --- variations of the default scenario drawn from seeds ------------------------------------------

LIMITS = {
    "observation.site_distance_min_m": (450.0, 520.0),
    "observation.site_distance_max_m": (710.0, 800.0),
    "observation.emission_min_deg": (12.0, 22.0),
    "observation.emission_max_deg": (42.0, 55.0),
    "observation.phase_min_deg": (5.0, 20.0),
    "observation.phase_max_deg": (70.0, 89.0),
    "battery.observation_cone_deg": (12.0, 22.0),
    "battery.delta_v_cone_deg": (15.0, 30.0),
    "safety.radius_min_m": (480.0, 560.0),
}
"""Between which each limit is drawn."""


def drawn(seed: int) -> tuple[str, Changes]:
    """A random scenario's name and changes to the default one; odd seeds require whole flights."""
    rng = np.random.default_rng([20200121, seed])
    scope: Literal["node", "flight"] = "flight" if seed % 2 else "node"
    risk: Changes = {
        "risk.allocation": "exact",
        "risk.scope": scope,
        "risk.p_chance": round(float(rng.uniform(0.55, 0.99)), 3),
    }
    found = risk | _errors(rng) | _boundary(rng)
    limits = {name: round(float(rng.uniform(*ends)), 2) for name, ends in LIMITS.items()}
    return f"{scope} {seed:02d}", found | limits


def _errors(rng: np.random.Generator) -> Changes:
    """Random errors: of the burns by either model, of the initial state in either form."""

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
    """Boundary states off by 20 m and 1 mm/s in every component, 1 sigma."""
    found: Changes = {}
    for name, values in PRINTED.items():
        off = rng.normal(scale=OFF_M if name.endswith("_m") else OFF_M_S, size=3)
        found[f"boundary.{name}"] = np.round(np.add(values, off), 6).tolist()
    return found
