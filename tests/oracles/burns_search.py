"""Search by the references in the burns alone: SciPy's SLSQP, and IPOPT with L-BFGS."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from time import process_time
from typing import Any, NamedTuple

import casadi as ca
import numpy as np
from scipy.optimize import minimize

from formulations.arrays import Array
from formulations.linearisation.linearisation import Linearisation, LinearisationError
from formulations.nlp.solve import QUASI_NEWTON
from scp_recon.mission.mission import Mission
from tests.oracles.burns_program import (
    GAIN,
    BurnsProgram,
    Point,
    Stop,
    rows_of,
)

ROUNDING = (1e-3, 3e-5)
"""Rounding of the cost's kinks, in units of speed, first and in the end."""

ITERATIONS = 100
AGAIN = 2
"""Times that SLSQP begins, the later ones where it stopped, as long as that gains `GAIN`."""
STILL = 1e-6

PATIENCE = {"SLSQP": 10, "IPOPT": 25}
"""Points without a gain: an interior point begins with some."""

WORST = 1e6
"""Violation, in every row, of burns that no finite flight has."""


@dataclass(frozen=True)
class Found:
    """The cheapest feasible burns, or the last ones if none were, shape (m, 3).

    `ended` gives their start and the solver's message; evaluations are those from all starts.
    """

    burns: Array
    holds: bool
    ended: str
    out_of_time: bool
    evaluations: int


class _End(NamedTuple):
    """End of one solver's run; its program holds the best point, if any."""

    start: str
    program: BurnsProgram
    burns: Array
    words: str


def search(
    mission: Mission, starts: Mapping[str, Linearisation], solver: str, limit_s: float
) -> Found:
    """Solve exact P2: from each start with few directions and a rounder cost, then in full.

    Results of the first runs are refined, the cheapest first, until one is feasible or `limit_s`
    seconds of processor time are over. The solver is a key of `SOLVERS`.
    """
    until = process_time() + limit_s
    few, many = rows_of(mission)
    first = [
        _run(solver, BurnsProgram(mission, few, ROUNDING[0], until, flown, PATIENCE[solver]), name)
        for name, flown in starts.items()
    ]
    ends, end = list(first), first[0]
    found = [(e, e.program.best) for e in first]
    for rough, best in sorted(
        ((e, best) for e, best in found if best is not None), key=lambda one: one[1].cost
    ):
        flown = rough.program.flown
        program = BurnsProgram(mission, many, ROUNDING[1], until, flown, PATIENCE[solver])
        end = _run(solver, program, rough.start, best.burns)
        ends.append(end)
        if program.best is not None:
            break
    best_of_all = end.program.best if len(ends) > len(first) else None
    burns = end.burns if best_of_all is None else best_of_all.burns
    return Found(
        burns.reshape(-1, 3),
        best_of_all is not None,
        f"from {end.start}: {end.words}",
        process_time() > until,
        sum(e.program.evaluations for e in ends),
    )


def _run(solver: str, program: BurnsProgram, start: str, burns: Array | None = None) -> _End:
    """One solver on one program, from some burns or those of the flight that it has."""
    burns = program.flown.iterate.burns.ravel() if burns is None else burns
    try:
        burns, words = SOLVERS[solver](program, burns)
    except Stop as stop:
        words = str(stop)
    return _End(start, program, burns, words)


def slsqp(program: BurnsProgram, burns: Array) -> tuple[Array, str]:
    """Sequential least squares programming (Kraft), restarted while that helps."""

    def seen(x: Array) -> Point | None:
        try:
            return program.at(x)
        except LinearisationError:
            return None

    first = program.at(burns)
    rows = {"eq": ("equal", "by_equal"), "ineq": ("least", "by_least")}

    def part(name: str, lost: float) -> Any:
        def of(x: Array) -> Any:
            point = seen(x)
            value = getattr(first if point is None else point, name)
            return value if point is not None else np.full_like(value, lost)

        return of

    constraints: Any = [
        {"type": kind, "fun": part(value, -WORST), "jac": part(slope, 0.0)}
        for kind, (value, slope) in rows.items()
    ]
    answer, before = None, np.inf
    options: Any = {"maxiter": ITERATIONS, "ftol": STILL}
    most = program.mission.problem.dv_max
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
        burns = program.best.burns if program.best else answer.x
        cost = program.best.cost if program.best else np.inf
        if not cost < before * (1.0 - GAIN):
            break
        before = cost
    return burns, "" if answer is None else str(answer.message)


class _Rows(ca.Callback):
    """The constraints, and with `slope` their Jacobian as well, for IPOPT.

    After the program has stopped, the values are constant until `_Halt` ends the run.
    """

    def __init__(self, program: BurnsProgram, point: Point, *, slope: bool) -> None:
        super().__init__()
        self.program, self.point, self.slope, self.words = program, point, slope, ""
        self.rows, self.unknowns = len(point.equal) + len(point.least), len(point.burns)
        self.construct("jacobian" if slope else "rows", {})

    def get_n_in(self) -> int:
        return 1 + self.slope

    def get_n_out(self) -> int:
        return 1 + self.slope

    def get_sparsity_in(self, i: int) -> ca.Sparsity:
        return ca.Sparsity.dense(self.unknowns if i == 0 else 0, 1)

    def get_sparsity_out(self, i: int) -> ca.Sparsity:
        return ca.Sparsity.dense(self.rows, 1 if i == 0 else self.unknowns)

    def eval(self, arguments: Sequence[ca.DM]) -> list[Array]:
        lost = False
        try:
            self.point = self.program.at(np.array(arguments[0]).ravel())
        except Stop as stop:
            self.words = str(stop)
        except LinearisationError:
            lost = True  # no number: IPOPT takes a shorter step
        point = self.point
        value = np.concatenate([point.equal, point.least])
        slope = np.vstack([point.by_equal, point.by_least])
        found = [value, slope] if self.slope else [value]
        return [np.full_like(part, np.nan) for part in found] if lost else found


class _Halt(ca.Callback):
    """Asked after each iteration of IPOPT, whether to end."""

    def __init__(self, unknowns: int, rows: int, asked: Sequence[_Rows]) -> None:
        super().__init__()
        self.sizes = dict.fromkeys(("x", "lam_x"), unknowns) | {"f": 1, "g": rows, "lam_g": rows}
        self.asked = asked
        self.construct("halt", {})

    def get_n_in(self) -> int:
        return int(ca.nlpsol_n_out())

    def get_n_out(self) -> int:
        return 1

    def get_sparsity_in(self, i: int) -> ca.Sparsity:
        return ca.Sparsity.dense(self.sizes.get(ca.nlpsol_out(i), 0), 1)

    def eval(self, arguments: Sequence[ca.DM]) -> list[int]:
        del arguments
        return [int(any(one.words for one in self.asked))]


def ipopt(program: BurnsProgram, burns: Array) -> tuple[Array, str]:
    """IPOPT through callbacks."""
    first = program.at(burns)
    values, slopes = (_Rows(program, first, slope=slope) for slope in (False, True))
    halt = _Halt(values.unknowns, values.rows, (values, slopes))
    x = ca.MX.sym("x", len(burns))
    size = ca.sqrt(ca.sum1(ca.reshape(x, 3, -1) ** 2) + program.rounding**2)
    options = QUASI_NEWTON.options() | {
        "jac_g": slopes,
        "no_nlp_grad": True,
        "iteration_callback": halt,
        "ipopt.max_iter": ITERATIONS,
        "ipopt.tol": 1e-6,
    }
    solver = ca.nlpsol("burns", "ipopt", {"x": x, "f": ca.sum2(size), "g": values(x)}, options)
    most = program.mission.problem.dv_max
    upper = np.concatenate([np.zeros(len(first.equal)), np.full(len(first.least), np.inf)])
    answer = solver(x0=burns, lbx=-most, ubx=most, lbg=0.0, ubg=upper)
    words = values.words or slopes.words or str(solver.stats()["return_status"])
    return np.array(answer["x"]).ravel(), words


SOLVERS = {"SLSQP": slsqp, "IPOPT": ipopt}
