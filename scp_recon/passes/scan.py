"""Map the least delta-v over both phases without uncertainty, each cell started from its neighbour.

Uncertainty only adds constraints: where P3 is expensive, so is P2.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np
from scipy.ndimage import minimum_filter

from formulations.arrays import Array
from formulations.problem.flyby import Iterate
from scp_recon.mission.firing import TURN
from scp_recon.mission.mission import Mission
from scp_recon.passes.space import Pass, Space
from scp_recon.passes.timing import PassResult
from scp_recon.planning.initial_guess import circular, cold, from_burns, random
from scp_recon.planning.plan import is_converged
from scp_recon.planning.planner import Planner, other_starts
from scp_recon.planning.stages import Pipeline, same_optimum

STEP = float(np.deg2rad(60.0))
"""Largest step between phases, rad."""
COARSER = 2.0
"""Factor by which the map's grid is coarser than the scenario's."""
ROUGH = 5e-2
"""Relative reduction of the merit at which a plan of the map stops. With 1e-2 and 15 iterations maps
take a quarter more time, and Nightingale's and Sandpiper's passes cost the same to 1e-4."""
ITERATIONS = 8
"""Limit of a map's plan: most that converge take 3 to 7, and a minimum converges soon."""
RANDOM = 4
"""Random guesses at one pair of phases, beside the cold start, the ballistic arc and the turns."""


def phases(span: tuple[float, float]) -> Array:
    """Evenly spaced phases of a span, rad, at most `STEP` apart; a whole turn's end is left out."""
    low, high = span
    if high - low >= TURN - 1e-9:
        return low + np.linspace(0.0, TURN, round(TURN / STEP), endpoint=False)
    return np.linspace(low, high, int(np.ceil((high - low) / STEP - 1e-9)) + 1)


def scan(space: Space, observe: Callable[[PassResult], object]) -> list[PassResult]:
    """Plan P3 at every pair of phases for a space's first times, row by row of departure, to and fro.

    Each cell starts from a turn about the body; if that does not converge, from the last cell's burns.
    One pair, as between given states, is planned from several guesses.
    """
    coarse = space.coarser(COARSER)
    rows, columns = (phases(span).tolist() for span in space.phase_spans)
    pairs = [(row, one) for k, row in enumerate(rows) for one in columns[:: -1 if k % 2 else 1]]
    if len(pairs) == 1:
        return _optima(space, Pass(pairs[0], space.times_s), observe)
    planner: Planner[Mission] | None = None
    cells: list[PassResult] = []
    for pair in pairs:
        at = Pass(pair, space.times_s)
        mission = coarse.mission_of(at)
        planner = planner or Planner(mission, p3_resolution=ROUGH)
        pipeline, spec = Pipeline(mission, planner), replace(planner.p3, max_iterations=ITERATIONS)
        stage = pipeline.solve(spec, pipeline.start(ahead(mission)))
        # Where neither converges, there is most often no pass at all.
        if not is_converged(stage) and cells and cells[-1].converged:
            start = pipeline.start(from_burns(mission, cells[-1].burns_m_s))
            stage = pipeline.solve(spec, start)
        cells.append(PassResult(space, at, mission, stage))
        observe(cells[-1])
    return cells


def _optima(space: Space, at: Pass, observe: Callable[[PassResult], object]) -> list[PassResult]:
    """Optima of P3, each found once: from one guess the last digits choose which one is found."""
    mission = space.coarser(COARSER).mission_of(at)
    planner = Planner(mission)
    pipeline, found = Pipeline(mission, planner), list[PassResult]()
    guesses = [guess for _, guess in other_starts(mission)]
    for guess in [cold(mission), *guesses, *(random(mission, seed) for seed in range(RANDOM))]:
        start = pipeline.start(guess)
        stage = pipeline.run(planner.p3_stages(start), start)
        observe(one := PassResult(space, at, mission, stage))
        if not any(same_optimum(stage, other.stage) for other in found):
            found.append(one)
    return found


def ahead(mission: Mission) -> Iterate:
    """A guess that turns steadily about the body, in the home orbit's sense at departure."""
    first, last = mission.initial_state, mission.final_state[:3]
    shorter = np.cross(first[:3], first[3:]) @ np.cross(first[:3], last) >= 0.0
    return circular(mission, 1.0 if shorter else -1.0)


def starts(cells: Sequence[PassResult], most: int) -> list[PassResult]:
    """Cells cheaper than all neighbours, the cheapest first; phases of a whole turn wrap around.

    With one pair of phases, as between given states, every optimum.
    """
    found = [one for one in cells if one.converged]
    if len({one.at.phases for one in cells}) > 1:
        rows, columns = (sorted({one.at.phases[k] for one in cells}) for k in (0, 1))
        cost = np.full((len(rows), len(columns)), np.inf)
        places = [(rows.index(one.at.phases[0]), columns.index(one.at.phases[1])) for one in found]
        for place, one in zip(places, found, strict=True):
            cost[place] = one.dv_m_s
        lowest = cost <= minimum_filter(cost, size=3, mode="wrap")
        found = [one for place, one in zip(places, found, strict=True) if lowest[place]]
    return sorted(found, key=lambda one: one.dv_m_s)[:most]
