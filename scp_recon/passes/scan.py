"""Map the least delta-v over both phases without uncertainty, each cell started from its neighbour.

Uncertainty only adds constraints: where P3 is expensive, so is P2.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace

import numpy as np

from formulations.arrays import Array
from formulations.problem.flyby import Iterate
from scp_recon.mission.firing import TURN
from scp_recon.mission.mission import Mission
from scp_recon.passes.space import Pass, Space
from scp_recon.passes.timing import PassResult
from scp_recon.planning.initial_guess import circular, from_burns
from scp_recon.planning.planner import Planner
from scp_recon.planning.stages import Pipeline

STEP = float(np.deg2rad(60.0))
"""Largest step between phases, rad."""
COARSER = 2.0
"""Factor by which the map's grid is coarser than the scenario's."""
ROUGH = 5e-2
"""Relative reduction of the merit at which a plan of the map stops. With 1e-2 and 15 iterations maps
take a quarter more time, and Nightingale's and Sandpiper's passes cost the same to 1e-4."""
ITERATIONS = 8
"""Limit of a map's plan: most that converge take 3 to 7, and a minimum converges soon."""


def phases(span: tuple[float, float]) -> Array:
    """Evenly spaced phases of a span, rad, at most `STEP` apart; a whole turn's end is left out."""
    low, high = span
    if high - low >= TURN - 1e-9:
        return low + np.linspace(0.0, TURN, round(TURN / STEP), endpoint=False)
    return np.linspace(low, high, int(np.ceil((high - low) / STEP - 1e-9)) + 1)


def scan(
    space: Space, times_s: tuple[float, ...], observe: Callable[[PassResult], None]
) -> list[PassResult]:
    """Plan P3 at every pair of phases for one set of times, row by row of departure, to and fro."""
    space = space.coarser(COARSER)
    planner: Planner[Mission] | None = None
    cells: list[PassResult] = []
    last: PassResult | None = None
    for departure, arrival in _to_and_fro(*map(phases, space.phase_spans)):
        at = Pass((departure, arrival), times_s)
        mission = space.mission_of(at)
        planner = planner or Planner(mission, p3_resolution=ROUGH)
        best = _cheapest(planner, at, mission, last)
        if not (best.converged or space.has_home):  # the only cell: other algorithms too
            stage = Planner(mission).plan(ahead(mission), problem="P3").final
            best = PassResult(at, mission, stage)
        cells.append(best)
        observe(best)
        last = best
    return cells


def _cheapest(
    planner: Planner[Mission], at: Pass, mission: Mission, last: PassResult | None
) -> PassResult:
    """Plan P3 from a turn about the body; if that does not converge, from the last cell's burns."""
    pipeline, spec = Pipeline(mission, planner), replace(planner.p3, max_iterations=ITERATIONS)

    def planned(guess: Iterate) -> PassResult:
        return PassResult(at, mission, pipeline.solve(spec, pipeline.start(guess)))

    found = planned(ahead(mission))
    if found.converged or last is None or not last.converged:
        return found  # where neither converges, there is most often no pass at all
    return planned(from_burns(mission, last.burns_m_s))


def ahead(mission: Mission) -> Iterate:
    """A guess that turns steadily about the body, in the home orbit's sense at departure."""
    first, last = mission.initial_state, mission.final_state[:3]
    shorter = np.cross(first[:3], first[3:]) @ np.cross(first[:3], last) >= 0.0
    return circular(mission, 1.0 if shorter else -1.0)


def _to_and_fro(rows: Array, columns: Array) -> Iterator[tuple[float, float]]:
    for number, row in enumerate(rows.tolist()):
        yield from ((row, column) for column in columns.tolist()[:: -1 if number % 2 else 1])


def starts(cells: Sequence[PassResult], most: int) -> list[PassResult]:
    """Cells cheaper than all neighbours, the cheapest first; phases of a whole turn wrap around."""
    rows, columns = (sorted({one.at.phases[k] for one in cells}) for k in (0, 1))
    cost = np.full((len(rows), len(columns)), np.inf)
    cell = {(rows.index(one.at.phases[0]), columns.index(one.at.phases[1])): one for one in cells}
    for (i, j), one in cell.items():
        cost[i, j] = one.dv_m_s
    around = [
        np.roll(cost, (i, j), (0, 1)) for i in (-1, 0, 1) for j in (-1, 0, 1) if (i, j) != (0, 0)
    ]
    least = np.isfinite(cost) & np.all([cost <= other for other in around], axis=0)
    kept = [cell[int(i), int(j)] for i, j in np.argwhere(least)]
    return sorted(kept, key=lambda one: one.dv_m_s)[:most]
