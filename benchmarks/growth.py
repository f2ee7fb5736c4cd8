"""Fit how the cost of a plan grows with nodes, facets and burns.

`python -m benchmarks.growth QUANTITY METHOD` does so for one of them by one method.
"""

from __future__ import annotations

import json
import sys
from collections.abc import Callable
from dataclasses import asdict, dataclass
from time import process_time

import numpy as np

from benchmarks.methods import LATE, imported
from formulations.arrays import Array
from formulations.problem.flyby import Iterate
from scp_recon.mission.mission import Mission
from scp_recon.planning import initial_guess, planner
from scp_recon.planning.plan import Plan
from scp_recon.scenario.load import load_scenario
from scp_recon.scp.status import Status

REPEATS, AGAIN_S = 5, 5.0
"""Plans of a size at most, and the seconds after which no further one is made."""


@dataclass(frozen=True)
class Study:
    """Sizes of one quantity, and the changes to a scenario that give them."""

    name: str
    sizes: tuple[int, ...]
    overrides: Callable[[int], list[str]]


@dataclass(frozen=True)
class Fit:
    """A method's plans by size.

    Attributes:
        name, method: the study's quantity, and the method.
        sizes: of the quantity.
        seconds: of the processor for a whole plan, the fastest of a few.
        iterations: of all its stages.
        statuses: how it ended.
        total_dv_m_s: its delta-v. Where that differs, methods did not find the same plan.
        exponent: of the power law of seconds through sizes that converged; None for fewer than two.
            Others took as long as there were starts and facets left to try.
        last: between the last two of them.
        an_iteration: exponent of seconds over iterations.
    """

    name: str
    method: str
    sizes: tuple[int, ...]
    seconds: tuple[float, ...]
    iterations: tuple[int, ...]
    statuses: tuple[str, ...]
    total_dv_m_s: tuple[float, ...]
    exponent: float | None
    last: float | None
    an_iteration: float | None


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


def by_ipopt(mission: Mission, start: Iterate) -> Plan:
    """Plan by IPOPT, by the quicker of its tuned variants at the default size."""
    from scp_recon.planning import ipopt

    return ipopt.plan(mission, start, variant="tuned")


METHODS: dict[str, Callable[[Mission, Iterate], Plan]] = {
    "scp condensed": planner.plan,
    "scp lifted": lambda mission, start: planner.plan(mission, start, formulation="lifted"),
    "ipopt tuned": by_ipopt,
}
LEFT_OUT = {("nodes", "scp lifted"): (2400,), ("burns", "scp lifted"): (12,)}
"""Sizes of which a plan takes minutes: 134 s with 2400 nodes; with 12 burns none after nine minutes."""


def fit(study: Study, method: str) -> Fit:
    """Time a study by a method."""
    imported(*LATE[method.split()[0]])
    left_out = LEFT_OUT.get((study.name, method), ())
    sizes = tuple(size for size in study.sizes if size not in left_out)
    plans, seconds = zip(
        *(_fastest(study.overrides(size), METHODS[method]) for size in sizes), strict=True
    )
    iterations = tuple(sum(len(stage.result.records) for stage in plan.stages) for plan in plans)
    converged = [i for i, plan in enumerate(plans) if plan.status is Status.CONVERGED]
    x, y = np.array(sizes, float)[converged], np.array(seconds)[converged]
    return Fit(
        study.name,
        method,
        sizes,
        seconds,
        iterations,
        tuple(plan.status.value.name for plan in plans),
        tuple(plan.total_dv_m_s for plan in plans),
        exponent(x, y),
        exponent(x[-2:], y[-2:]),
        exponent(x, y / np.array(iterations)[converged]),
    )


def exponent(sizes: Array, values: Array) -> float | None:
    """Exponent of the power law through values by size, each of shape (n,); None for fewer than two."""
    if len(sizes) < 2:
        return None
    return float(np.polyfit(np.log(sizes), np.log(values), 1)[0])


def _fastest(
    overrides: list[str], make_plan: Callable[[Mission, Iterate], Plan]
) -> tuple[Plan, float]:
    mission = Mission.from_scenario(load_scenario(None, overrides))
    start, seconds = initial_guess.cold(mission), list[float]()
    while len(seconds) < REPEATS and sum(seconds) < AGAIN_S:
        begin = process_time()
        plan = make_plan(mission, start)
        seconds.append(process_time() - begin)
    return plan, min(seconds)


def main() -> None:
    """Print a study's fit by a method as JSON."""
    name, method = sys.argv[1:]
    study = next(study for study in STUDIES if study.name == name)
    print(json.dumps(asdict(fit(study, method))))


if __name__ == "__main__":
    main()
