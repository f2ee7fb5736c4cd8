"""Search for the cheapest burns of exact P2 by SciPy's SLSQP, in the burns alone."""

from __future__ import annotations

from time import process_time
from typing import Any

import numpy as np
from scipy.optimize import minimize

from formulations.arrays import Array
from formulations.linearisation.linearisation import Linearisation, LinearisationError
from scp_recon.mission.mission import Mission
from tests.oracles.burns_program import GAIN, RAYS, BurnsProgram, NodeRows, Point, Stop

ROUGH, FINE = (512, 1e-3), (RAYS, 3e-5)
"""Rays of a node and rounding of the cost's kinks, in units of speed, first and in the end."""

AGAIN, PATIENCE, ITERATIONS, STILL = 2, 10, 100, 1e-6
"""Runs, the later ones as long as they gain `GAIN`; points without a gain; and limits of each run."""

WORST = 1e6
"""Violation, in every row, of burns that no finite flight has."""


def search(mission: Mission, start: Linearisation, limit_s: float) -> Array | None:
    """The cheapest feasible burns from a start, shape (m, 3), with few rays first; None if none are.

    After `limit_s` seconds of processor time the best ones so far count.
    """
    until, burns, flown = process_time() + limit_s, start.iterate.burns.ravel(), start
    for rays, rounding in (ROUGH, FINE):
        rows = NodeRows(mission.problem, mission.scenario.risk.p_chance, rays)
        program = BurnsProgram(mission, rows, rounding, until, flown, PATIENCE)
        try:
            burns = slsqp(program, burns)
        except Stop:
            burns = burns if program.best is None else program.best.burns
        flown = program.flown
    return None if program.best is None else program.best.burns.reshape(-1, 3)


def slsqp(program: BurnsProgram, burns: Array) -> Array:
    """Sequential least squares programming (Kraft), restarted while that helps."""
    first = program.at(burns)

    def part(name: str, lost: float) -> Any:
        def of(x: Array) -> Any:
            try:
                return getattr(program.at(x), name)
            except LinearisationError:
                return np.full_like(getattr(first, name), lost)

        return of

    constraints: Any = [
        {"type": kind, "fun": part(value, -WORST), "jac": part(slope, 0.0)}
        for kind, value, slope in (("eq", "equal", "by_equal"), ("ineq", "least", "by_least"))
    ]
    options: Any = {"maxiter": ITERATIONS, "ftol": STILL}
    most, before = program.mission.problem.dv_max, np.inf
    for _ in range(AGAIN):
        answer = minimize(
            part("cost", WORST),
            burns,
            jac=part("by_cost", 0.0),
            bounds=[(-most, most)] * len(burns),
            constraints=constraints,
            method="SLSQP",
            options=options,
        )
        best: Point | None = program.best
        burns, cost = (best.burns, best.cost) if best else (answer.x, np.inf)
        if not cost < before * (1.0 - GAIN):
            break
        before = cost
    return burns
