"""Solve a halo transfer with the planner and with other tools; needs the extra [peers].

The halo transfer of `examples` is the own test of scocp (SCvx*, by CVXPY and Clarabel). OpenSCvx (PTR,
QOCO) takes it too. Every tool integrates an arc between burns to 1e-9: the planner by the classical
Runge-Kutta scheme in 40 steps, which errs by at most 7e-10 along the optimum; the others adaptively
with that tolerance. Burns are then flown by DOP853 to 1e-13.

From the guess of scocp's test, both orbits blended, and from 20 others: states bent by three random
sines of a tenth of the units in every component. A tool has solved the transfer if it reports
convergence, its burns miss the final state by at most 1e-5, and no tool is cheaper by more than
1e-4.

Seconds are of the processor, libraries imported. Set-up is building and compiling what serves every
guess; scocp has none, and the planner's, of a few hundredths of a second, is part of each solve.

OpenSCvx 0.5.2 is used as its users would: symbolic dynamics, impulsive controls, the nodes' times as
fixed states. It has no chance constraints, and no size of an impulse, whose derivative at the nodes
without a burn is not a number: a second control bounds it from above, in the cost.
"""

from __future__ import annotations

import contextlib
import importlib
import io
import runpy
from collections.abc import Sequence
from functools import partial
from pathlib import Path
from time import process_time
from typing import NamedTuple

import numpy as np
import pandas as pd
from scipy.integrate import solve_ivp

from experiments.harness import Findings, Record, Session, Study
from formulations.arrays import Array
from formulations.registry import FORMULATIONS
from scp_recon.errors import needing
from scp_recon.impulsive.problem import ImpulsiveProblem
from scp_recon.monte_carlo.estimates import proportion
from scp_recon.scp.algorithms import ALGORITHMS


class Settings(NamedTuple):
    """OpenSCvx's tolerance of the integration, relative and absolute, and the algorithm's options.

    By default `lam_cost` is 0.01, `lam_vc` 1, `lam_vb` 0 (weights of cost, virtual control and virtual
    buffer), and `ep_tr`, the size of a step at which it stops, 1e-4.
    """

    tolerance: float
    lam_cost: float = 1e-2
    lam_vc: float = 1.0
    lam_vb: float = 1.0
    ep_tr: float = 1e-4

    def __str__(self) -> str:
        """Tolerance and weights."""
        return f"OpenSCvx, {self.tolerance:g}, ptr " + " ".join(f"{x:g}" for x in self[1:])


Method = tuple[str, str] | Settings | str
"""Formulation and algorithm of the planner, settings of OpenSCvx, or scocp."""

EXAMPLE = Path(__file__).parents[2] / "examples" / "halo_transfer.py"
TOLERANCE, ITERATIONS = 1e-9, 200
SEEDS, SCALE, SINES = 20, 0.1, 3
MISSED, DEARER = 1e-5, 1e-4
OURS = tuple((form, algorithm) for form in FORMULATIONS[:2] for algorithm in ALGORITHMS)
"""Formulations that differ without errors, and algorithms."""
WEIGHTS = (
    Settings(TOLERANCE),
    Settings(TOLERANCE, 1.0, 1e2, 1e2, 1e-8),
    Settings(TOLERANCE, 10.0, 1e3, 1e3, 1e-8),
)
GUESSED: tuple[Method, ...] = (*OURS[:4], "scocp", WEIGHTS[1])


class Answer(NamedTuple):
    """A tool's burns, shape (m, 3), its status, iterations and seconds of the processor."""

    burns: Array
    status: str
    iterations: int
    solve_s: float
    set_up_s: float = 0.0

    def row(self, method: Method, cost: float, missed: float) -> Record:
        """A row of the tables."""
        return {
            "method": str(method) if isinstance(method, str | Settings) else "/".join(method),
            "status": self.status.replace("_", " "),
            "cost": cost,
            "missed": missed,
            "iterations": self.iterations,
            "set_up_s": self.set_up_s,
            "solve_s": self.solve_s,
        }


class OpenScvx:
    """The halo transfer, posed and compiled in OpenSCvx, with the guess of its states (m, 6)."""

    def __init__(self, settings: Settings, halo: Halo, guess: Array) -> None:
        import openscvx as ox

        begin, times, n = process_time(), halo.times[halo.nodes], len(halo.nodes)
        end, dv_max, every = float(times[-1]), halo.problem.dv_max, list(range(n))
        position, velocity = ox.State("position", shape=(3,)), ox.State("velocity", shape=(3,))
        spent = ox.State("spent", shape=(1,))
        burn, size = (
            ox.Control(name, shape=(k,), parameterization="impulsive", nodes=every)
            for name, k in (("burn", 3), ("size", 1))
        )
        self._variables = position, velocity, spent, burn, size
        for state, part in ((position, slice(0, 3)), (velocity, slice(3, 6))):
            state.min, state.max = [-3.0] * 3, [3.0] * 3
            state.initial, state.final = (one[part] for one in halo.ends)
        spent.min, spent.max, spent.initial = [0.0], [dv_max * n], [0.0]
        spent.final = [ox.Minimize(0.0)]
        burn.min, burn.max, size.min, size.max = [-dv_max] * 3, [dv_max] * 3, [0.0], [dv_max]
        self._guess(guess)
        # By default arcs have three tenths of the mean at least, which those of the window have not.
        least = min(0.5 * float(np.diff(times).min()) * (n - 1), 0.3 * end)
        bounds = {"min": 0.0, "max": end, "time_dilation_min": least}
        time = ox.Time(initial=0.0, final=end, guess=times, **bounds)
        fixed = [(time[0] == float(times[k])).convex().at([k]) for k in range(1, n - 1)]
        sizes = [(ox.linalg.Norm(burn) <= size[0]).convex().at([k]) for k in every]
        algorithm = settings._asdict()
        tolerance = algorithm.pop("tolerance")
        pull = halo.acceleration(position, velocity, time, [halo.mu])
        with contextlib.redirect_stdout(io.StringIO()):  # it prints a table as it goes
            self._problem = ox.Problem(
                dynamics={
                    "position": velocity,
                    "velocity": ox.Concat(*pull),
                    "spent": ox.Constant(np.zeros(1)),
                },
                dynamics_discrete={
                    "position": position,
                    "velocity": velocity + burn,
                    "spent": spent + size,
                },
                states=[position, velocity, spent],
                controls=[burn, size],
                time=time,
                constraints=[*fixed, *sizes],
                N=n,
                float_dtype="float64",
                algorithm=algorithm,
                discretizer={"diffrax_kwargs": {"rtol": tolerance, "atol": tolerance}},
            )
            self._problem.initialize()
        self.set_up_s = process_time() - begin

    def _guess(self, states: Array) -> None:
        """Begin at states with no burns."""
        position, velocity, spent, burn, size = self._variables
        n = len(states)
        position.guess, velocity.guess = states[:, :3], states[:, 3:]
        spent.guess, burn.guess, size.guess = np.zeros((n, 1)), np.zeros((n, 3)), np.zeros((n, 1))

    def solve(self, states: Array) -> Answer:
        """Solve from states at the nodes, shape (m, 6)."""
        begin = process_time()
        self._guess(states)
        with contextlib.redirect_stdout(io.StringIO()):
            self._problem.reset()
            found = self._problem.solve(max_iters=ITERATIONS)
        seconds, burns = process_time() - begin, np.asarray(found.nodes["burn"])
        status = "converged" if found.converged else "not converged"
        return Answer(burns, status, self._problem.state.k - 1, seconds, self.set_up_s)


# --- the halo transfer ----------------------------------------------------------------------------


class Halo:
    """The problem of the example, and its guesses."""

    def __init__(self) -> None:
        with contextlib.redirect_stdout(io.StringIO()):
            names = runpy.run_path(str(EXAMPLE))
        self.problem: ImpulsiveProblem = names["problem"]
        self.acceleration, self.mu = names["acceleration"], float(names["MU"])
        self.blended, self.nodes, self.times = names["guess"], names["nodes"], names["times"]
        self.ends = np.array(names["START"]), np.array(names["GOAL"])
        self._compiled: dict[Settings, OpenScvx] = {}

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
        state, times = self.ends[0].copy(), self.times[self.nodes]
        for k, burn in enumerate(burns):
            state[3:] += burn
            if k + 1 < len(burns):
                span = times[k], times[k + 1]
                flown = solve_ivp(self._rate, span, state, method="DOP853", rtol=1e-13, atol=1e-13)
                state = flown.y[:, -1].copy()
        return float(np.abs(state - self.ends[1]).max())

    def _rate(self, t: float, state: Array) -> Array:
        return np.array([*state[3:], *self.acceleration(state[:3], state[3:], t, [self.mu])])

    def row(self, method: Method, seed: int | None = None) -> Record:
        """A method's row from a guess."""
        guess = self.guess(seed)
        if isinstance(method, Settings):
            found = self._openscvx(method, guess[self.nodes])
        elif method == "scocp":
            found = self._scocp(guess[self.nodes])
        else:
            begin = process_time()
            plan = self.problem.solve(guess, formulation=method[0], algorithm=method[1])
            seconds = process_time() - begin
            found = Answer(plan.burns, plan.status.value.name, plan.iterations, seconds)
        cost = float(np.linalg.norm(found.burns, axis=1).sum())
        return found.row(method, cost, self.missed(found.burns)) | {"seed": seed}

    def _scocp(self, guess: Array) -> Answer:
        """By scocp, with its test's tolerances and limit of iterations."""
        import scocp

        begin, n = process_time(), len(self.nodes)
        within = {"method": "DOP853", "reltol": TOLERANCE, "abstol": TOLERANCE}
        rates = scocp.rhs_cr3bp, scocp.rhs_cr3bp_stm
        flow = scocp.ScipyIntegrator(6, 3, *rates, args=(self.mu,), **within)
        posed = scocp.FixedTimeImpulsiveRdv(*self.ends, flow, self.times[self.nodes])
        algorithm = scocp.SCvxStar(posed, tol_opt=1e-4, tol_feas=1e-10)
        start = guess.copy(), np.zeros((n, 3)), np.zeros((n, 1))
        found = algorithm.solve(*start, maxiter=100, verbose=False)
        told = found.summary_dict
        status = {"Optimal": "converged"}.get(told["status"], told["status"])
        burns = np.full((n, 3), np.nan) if found.u is None else found.u
        return Answer(burns, status, told["num_iter"], process_time() - begin)

    def _openscvx(self, settings: Settings, guess: Array) -> Answer:
        """By OpenSCvx, compiled once."""
        if settings not in self._compiled:
            self._compiled[settings] = OpenScvx(settings, self, guess)
        return self._compiled[settings].solve(guess)


# --- the study ------------------------------------------------------------------------------------


def run(session: Session) -> Findings:
    """Solve the transfer by all, then by some from the other guesses."""
    with needing("peers", "peers"):
        for name in ("openscvx", "scocp"):
            importlib.import_module(name)
    halo = Halo()
    every: tuple[Method, ...] = (*OURS, "scocp", *WEIGHTS)
    solves = {f"{method}": partial(halo.row, method) for method in every}
    for seed in range(SEEDS):
        for method in GUESSED:
            solves[f"{method}|{seed}"] = partial(halo.row, method, seed)
    rows = session.rows("solves", lambda key: solves[key](), solves, session.store())
    once = [
        {name: row[name] for name in row if name != "seed"} | {"cost": f"{row['cost']:.7f}"}
        for row in rows
        if row.get("seed") is None
    ]
    bent = [row for row in rows if row.get("seed") is not None]
    return Findings({"methods": once, "guesses": guesses(bent)})


def guesses(rows: Sequence[Record]) -> list[Record]:
    """A row for each method: from how many guesses it solves the transfer, and how long it takes."""
    found = pd.DataFrame(rows)
    told = found.status == "converged"
    cost = found.cost.where(told & (found.missed <= MISSED))
    solved, lines = cost <= cost.min() * (1.0 + DEARER), []
    for method, own in found.groupby("method", sort=False):
        share = proportion(int(solved[own.index].sum()), len(own))
        median, most = own.solve_s.quantile([0.5, 0.9])
        lines.append(
            {
                "method": method,
                "guesses": len(own),
                "says_converged": int(told[own.index].sum()),
                "solved": int(solved[own.index].sum()),
                "interval": f"{100 * share.low:.0f} to {100 * share.high:.0f} %",
                "median_iterations": own.iterations.median(),
                "median_s": median,
                "90th_percentile_s": most,
            }
        )
    return lines


STUDY = Study(__doc__, run)
