"""Fit how the cost of a plan grows with nodes, facets and burns."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from scp_recon.mission.mission import Mission
from scp_recon.planning import initial_guess
from scp_recon.planning.planner import Planner
from scp_recon.scenario.load import load_scenario

REPEATS = 5


@dataclass(frozen=True)
class Study:
    """Sizes of one quantity, and the changes to a scenario that give them."""

    name: str
    sizes: tuple[int, ...]
    overrides: Callable[[int], list[str]]


@dataclass(frozen=True)
class Fit:
    """Seconds, iterations and status of a whole plan by size, the fastest of a few.

    The exponents are of the power law through all sizes, and between the last two.
    """

    name: str
    sizes: tuple[int, ...]
    seconds: tuple[float, ...]
    iterations: tuple[int, ...]
    statuses: tuple[str, ...]
    exponent: float
    last: float


def burn_times(count: int) -> list[str]:
    """Times of a number of burns, none near the observation window, without attitude modes between."""
    early = np.linspace(0.0, 11_000.0, -(-count // 2))
    late = np.linspace(19_000.0, 34_842.0, count // 2) if count > 2 else [34_842.0]
    times = [round(float(time), 1) for time in (*early, *late)]
    modes = [f"schedule.{name}_s=1.0" for name in ("attitude", "heating", "recharge")]
    return [f"burns.times_s={times}", *modes]


STUDIES = (
    Study("nodes", (75, 150, 300, 600, 1200, 2400), lambda n: [f"grid.step_max_s={34_842 / n}"]),
    Study(
        "facets of each polytope",
        (4, 8, 16, 32, 64, 128),
        lambda n: [f"polytopes.ball={n}", f"polytopes.cone={n}"],
    ),
    Study("burns", (2, 4, 6, 8, 12), burn_times),
)


def fit(study: Study) -> Fit:
    """Time a study."""
    seconds, iterations, statuses = zip(
        *(_plan(study.overrides(size)) for size in study.sizes), strict=True
    )
    x, y = np.log(study.sizes), np.log(seconds)
    return Fit(
        study.name,
        study.sizes,
        seconds,
        iterations,
        statuses,
        float(np.polyfit(x, y, 1)[0]),
        float((y[-1] - y[-2]) / (x[-1] - x[-2])),
    )


def _plan(overrides: list[str]) -> tuple[float, int, str]:
    mission = Mission.from_scenario(load_scenario(None, overrides))
    start = initial_guess.cold(mission)
    best = min((Planner(mission).plan(start) for _ in range(REPEATS)), key=lambda p: p.total_s)
    iterations = sum(len(stage.result.records) for stage in best.stages)
    return best.total_s, iterations, best.final.result.status.value.name
