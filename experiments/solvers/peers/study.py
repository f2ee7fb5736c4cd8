"""Solve two problems with the planner and with other tools; needs the extra [peers].

The halo transfer of `examples` is the own test of scocp (SCvx*, by CVXPY and Clarabel). OpenSCvx (PTR,
QOCO) takes it too, and P3 of the default scenario. Every tool integrates an arc between burns to 1e-9:
the planner by the classical Runge-Kutta scheme in 40 steps, which errs by at most 7e-10 along the
optimum; the others adaptively with that tolerance. Burns are then flown by another integrator (of the
halo transfer DOP853 to 1e-13; of P3 the planner's own dynamics on its grid, judged by its merit).

From the guess of scocp's test, both orbits blended, and from 20 others: states bent by three random
sines of a tenth of the units in every component. A tool has solved the transfer if it reports
convergence, its burns miss the final state by at most 1e-5, and no tool is cheaper by more than
1e-4.

Seconds are of the processor, libraries imported. Set-up is building and compiling what serves every
guess; scocp has none, and the planner's, of a few hundredths of a second, is part of each solve.
"""

from __future__ import annotations

import contextlib
import importlib.util
import io
import runpy
from collections.abc import Sequence
from functools import partial
from pathlib import Path
from time import process_time
from typing import NamedTuple

import numpy as np
from scipy.integrate import solve_ivp

from experiments.harness import Findings, Record, Session, Study
from experiments.solvers.cells import rolled_out
from experiments.solvers.peers.openscvx import Answer, Settings, Solver, Transfer, solve_p3
from formulations.arrays import Array
from formulations.problem.flyby import Iterate
from formulations.program.subproblem import MeritFunction
from formulations.registry import FORMULATIONS
from formulations.rows.uniform import DeterministicRows
from scp_recon.api.options import PlanOptions
from scp_recon.api.planning import plan_mission
from scp_recon.errors import InputError
from scp_recon.impulsive.problem import ImpulsiveProblem
from scp_recon.jobs.job import Job
from scp_recon.mission.mission import Mission
from scp_recon.monte_carlo.estimates import proportion
from scp_recon.planning import initial_guess
from scp_recon.results.table import Column, Table
from scp_recon.scenario.load import load_scenario
from scp_recon.scp.algorithms import ALGORITHMS

Method = tuple[str, str] | Settings | str
"""Formulation and algorithm of the planner, settings of OpenSCvx, or scocp."""

EXAMPLE = Path(__file__).parents[3] / "examples" / "halo_transfer.py"
TOLERANCE = 1e-9
SEEDS, SCALE, SINES = 20, 0.1, 3
MISSED, DEARER = 1e-5, 1e-4
OURS = tuple((form, algorithm) for form in FORMULATIONS[:2] for algorithm in ALGORITHMS)
"""Formulations that differ without errors, and algorithms."""
WEIGHTS = (
    Settings(TOLERANCE),
    Settings(TOLERANCE, 1.0, 1e2, 1e2, 1e-8),
    Settings(TOLERANCE, 10.0, 1e3, 1e3, 1e-8),
)
P3_CASES = ((5, WEIGHTS[0]), (5, Settings(1e-10, 0.1, 10.0, 10.0, 1e-6)), (5, WEIGHTS[2]))
"""Strides and settings."""
GUESSED: tuple[Method, ...] = (*OURS[:4], "scocp", WEIGHTS[1])
HALO, P3 = "halo transfer", "P3"


class Found(NamedTuple):
    """Result of a tool: convergence or another status, burns, iterations, seconds."""

    status: str
    burns: Array
    iterations: int
    set_up_s: float
    solve_s: float


# --- the halo transfer ----------------------------------------------------------------------------


class Halo:
    """The problem of the example, and its guesses."""

    def __init__(self) -> None:
        with contextlib.redirect_stdout(io.StringIO()):
            names = runpy.run_path(str(EXAMPLE))
        self.problem: ImpulsiveProblem = names["problem"]
        self.acceleration, self.mu = names["acceleration"], float(names["MU"])
        self.blended, self.nodes, self.times = names["guess"], names["nodes"], names["times"]
        self.start, self.goal = np.array(names["START"]), np.array(names["GOAL"])
        self._compiled: dict[Settings, tuple[Solver, float]] = {}

    def guess(self, seed: int | None) -> Array:
        """States at the grid's nodes, shape (n + 1, 6): the blended ones, bent if there is a seed."""
        if seed is None:
            return self.blended
        along = np.pi * self.times / self.times[-1]
        sines = np.sin(np.outer(along, np.arange(1, SINES + 1)))
        return self.blended + SCALE * sines @ np.random.default_rng(seed).normal(size=(SINES, 6))

    def missed(self, burns: Array) -> float:
        """By how much burns miss the final state, the largest component."""
        if not np.isfinite(burns).all():
            return np.inf
        state, times = self.start.copy(), self.times[self.nodes]
        for k, burn in enumerate(burns):
            state[3:] += burn
            if k + 1 < len(burns):
                span = times[k], times[k + 1]
                flown = solve_ivp(self._rate, span, state, method="DOP853", rtol=1e-13, atol=1e-13)
                state = flown.y[:, -1].copy()
        return float(np.abs(state - self.goal).max())

    def _rate(self, t: float, state: Array) -> Array:
        return np.array([*state[3:], *self.acceleration(state[:3], state[3:], t, [self.mu])])

    def ours(self, method: tuple[str, str], seed: int | None) -> Found:
        """By the planner, with a formulation and an algorithm."""
        begin = process_time()
        plan = self.problem.solve(self.guess(seed), formulation=method[0], algorithm=method[1])
        taken = process_time() - begin
        return Found(plan.status.value.name, plan.burns, plan.iterations, 0.0, taken)

    def scocp(self, seed: int | None) -> Found:
        """By scocp, with its test's tolerances and limit of iterations."""
        import scocp

        guess, begin = self.guess(seed)[self.nodes], process_time()
        within = {"method": "DOP853", "reltol": TOLERANCE, "abstol": TOLERANCE}
        flow = scocp.ScipyIntegrator(
            6, 3, scocp.rhs_cr3bp, scocp.rhs_cr3bp_stm, args=(self.mu,), **within
        )
        posed = scocp.FixedTimeImpulsiveRdv(self.start, self.goal, flow, self.times[self.nodes])
        n = len(self.nodes)
        algorithm = scocp.SCvxStar(posed, tol_opt=1e-4, tol_feas=1e-10)
        start = guess.copy(), np.zeros((n, 3)), np.zeros((n, 1))
        found = algorithm.solve(*start, maxiter=100, verbose=False)
        told = found.summary_dict
        status = {"Optimal": "converged"}.get(told["status"], told["status"])
        burns = np.full((n, 3), np.nan) if found.u is None else found.u
        return Found(status, burns, told["num_iter"], 0.0, process_time() - begin)

    def openscvx(self, settings: Settings, seed: int | None) -> Found:
        """By OpenSCvx."""
        guess, none = self.guess(seed)[self.nodes], np.zeros((len(self.nodes), 3))
        begin = process_time()
        if settings not in self._compiled:
            transfer = Transfer(
                self.times[self.nodes],
                np.arange(len(self.nodes)),
                self.start,
                self.goal,
                self.problem.dv_max,
                lambda r, v, t: self.acceleration(r, v, t, [self.mu]),
            )
            solver = Solver(transfer, settings, guess, none)
            self._compiled[settings] = solver, process_time() - begin
        solver, set_up_s = self._compiled[settings]
        begin = process_time()
        answer = solver.solve(guess, none)
        return _of(answer, set_up_s, process_time() - begin)

    def row(self, method: Method, seed: int | None = None) -> Record:
        """A method's row from a guess."""
        match method:
            case Settings():
                found = self.openscvx(method, seed)
            case (_, _):
                found = self.ours(method, seed)
            case _:
                found = self.scocp(seed)
        cost = float(np.linalg.norm(found.burns, axis=1).sum())
        return _record(HALO, named(method), found, cost, self.missed(found.burns)) | {"seed": seed}


def named(method: Method) -> str:
    """A method in the tables."""
    return "/".join(method) if isinstance(method, tuple) else str(method)


def _of(answer: Answer, set_up_s: float, solve_s: float) -> Found:
    status = "converged" if answer.converged else "not converged"
    return Found(status, answer.burns, answer.iterations, set_up_s, solve_s)


def _record(problem: str, method: str, found: Found, cost: float, missed: float) -> Record:
    return {
        "problem": problem,
        "method": method,
        "status": found.status.replace("_", " "),
        "cost": cost,
        "missed": missed,
        "iterations": found.iterations,
        "set_up_s": found.set_up_s,
        "solve_s": found.solve_s,
    }


# --- P3 -------------------------------------------------------------------------------------------


def p3_row(mission: Mission, start: Iterate, algorithm: str, solver: str) -> Record:
    """P3 by the planner."""
    begin = process_time()
    done = plan_mission(
        mission, start, PlanOptions(problem="P3", algorithm=algorithm, solver=solver)
    )
    taken, result = process_time() - begin, done.final.result
    status, burns = result.status.value.name, result.lin.iterate.burns
    iterations = sum(len(stage.result.records) for stage in done.stages)
    found = Found(status, burns, iterations, 0.0, taken)
    return _judged(mission, f"condensed/{algorithm}/{solver}", found)


def p3_peer(mission: Mission, start: Iterate, stride: int, settings: Settings) -> Record:
    """P3 by OpenSCvx on every so many-th node."""
    begin = process_time()
    answer = solve_p3(mission, start, stride, settings)
    found = _of(answer, 0.0, process_time() - begin)
    return _judged(mission, f"{settings}, every {stride}th node", found)


def _judged(mission: Mission, method: str, found: Found) -> Record:
    """Of burns flown on the planner's grid: delta-v, m/s, and the worst violation, m."""
    lin = rolled_out(mission, found.burns)
    merit = MeritFunction(mission.problem, DeterministicRows(mission.problem))
    missed = merit.worst_violation(lin) * mission.units.length_m
    return _record(P3, method, found, lin.iterate.total_dv * mission.units.speed_m_s, missed)


# --- the study ------------------------------------------------------------------------------------


def run(session: Session) -> Findings:
    """Solve both problems by all, then the transfer from the other guesses."""
    missing = [name for name in ("openscvx", "scocp") if importlib.util.find_spec(name) is None]
    if missing:
        raise InputError("the peers", f"no {missing[0]}", "install the extra scp_recon[peers]")
    halo, mission = Halo(), Mission.from_scenario(load_scenario())
    start = initial_guess.ballistic(mission)
    every: tuple[Method, ...] = (*OURS, "scocp", *WEIGHTS)
    solves = {f"{HALO}|{named(method)}": partial(halo.row, method) for method in every}
    for of in (("scvx", "CLARABEL"), ("ptr", "QOCO")):
        solves[f"{P3}|{of}"] = partial(p3_row, mission, start, *of)
    for case in P3_CASES:
        solves[f"{P3}|{case}"] = partial(p3_peer, mission, start, *case)
    for seed in range(SEEDS):
        for method in GUESSED:
            solves[f"{named(method)}|{seed}"] = partial(halo.row, method, seed)
    jobs = [Job(key, key) for key in solves]
    rows = session.rows(
        "solves",
        lambda key: solves[key](),
        jobs,
        session.store(),
        line=_line,
    )
    once = [row for row in rows if row.get("seed") is None]
    bent = [row for row in rows if row.get("seed") is not None]
    tables = methods(once), guesses(bent)
    return Findings({f"{table.key}.csv": table for table in tables})


def methods(rows: Sequence[Record]) -> Table:
    """A line for each problem and method."""
    columns = (
        "problem", "method", "status", "cost", Column("missed", form=".1e"), "iterations",
        Column("set-up", "s", ".2f"), Column("solve", "s", ".2f"),
    )  # fmt: skip
    names = ("problem", "method", "status", "cost", "missed", "iterations", "set_up_s", "solve_s")
    cells = [[row[name] for name in names] for row in rows]
    for line in cells:
        line[3] = f"{line[3]:.7f}" if line[0] == HALO else f"{line[3]:.6f}"
    return Table.of("One guess", columns, cells, key="methods")


def guesses(rows: Sequence[Record]) -> Table:
    """A line for each method: from how many guesses it solves the transfer, and how long it takes."""
    sound = [row for row in rows if row["status"] == "converged" and row["missed"] <= MISSED]
    best = min(row["cost"] for row in sound)
    columns = (
        "method", "guesses", "says converged", "solved", Column("95 % interval", name="interval"),
        Column("median iterations", form=".0f"), Column("median", "s", ".2f"),
        Column("90th percentile", "s", ".2f"),
    )  # fmt: skip
    lines = []
    for method in dict.fromkeys(row["method"] for row in rows):
        own = [row for row in rows if row["method"] == method]
        solved = [r for r in own if r in sound and r["cost"] <= best * (1.0 + DEARER)]
        share = proportion(len(solved), len(own))
        seconds = np.quantile([row["solve_s"] for row in own], (0.5, 0.9)).tolist()
        middle = float(np.median([row["iterations"] for row in own]))
        told = sum(row["status"] == "converged" for row in own)
        interval = f"{100 * share.low:.0f} to {100 * share.high:.0f} %"
        lines.append((method, len(own), told, len(solved), interval, middle, *seconds))
    return Table.of("Twenty other guesses", columns, lines, key="guesses")


def _line(row: Record) -> str:
    at = "" if row.get("seed") is None else f" from guess {row['seed']}"
    return f"{row['problem']}, {row['method']}{at}: {row['status']} at {row['cost']:.7f}"


STUDY = Study(__doc__, run)
