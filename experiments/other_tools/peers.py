"""Solve a halo transfer with the planner and with scocp; needs the extra [peers].

The halo transfer of `examples` is the own test of scocp (SCvx*, by CVXPY and Clarabel). Both tools
integrate an arc between burns to 1e-9: the planner by the classical Runge-Kutta scheme in 40 steps,
which errs by at most 7e-10 along the optimum; scocp adaptively with that tolerance. Burns are then
flown by DOP853 to 1e-13. OUT/methods.csv has a row for each method. Seconds are of the processor,
libraries imported.
"""

from __future__ import annotations

import contextlib
import importlib
import io
import runpy
from pathlib import Path
from time import process_time

import numpy as np
from scipy.integrate import solve_ivp

from experiments.harness import Record, Session, Study, Tables
from formulations.arrays import Array
from scp_recon.errors import needing
from scp_recon.impulsive.problem import ImpulsiveProblem
from scp_recon.scp.algorithms import ALGORITHMS

EXAMPLE = Path(__file__).parents[2] / "examples" / "halo_transfer.py"
TOLERANCE = 1e-9
SCOCP = "scocp"


class Halo:
    """The problem of the example."""

    def __init__(self) -> None:
        with contextlib.redirect_stdout(io.StringIO()):
            names = runpy.run_path(str(EXAMPLE))
        self.problem: ImpulsiveProblem = names["problem"]
        self.acceleration, self.mu = names["acceleration"], float(names["MU"])
        self.guess, self.nodes = names["guess"], names["nodes"]
        self.times = names["times"][self.nodes]
        self.ends = np.array(names["START"]), np.array(names["GOAL"])

    def missed(self, burns: Array) -> float:
        """By how much burns miss the final state, the largest component."""
        if not np.isfinite(burns).all():
            return np.inf
        state = self.ends[0].copy()
        for k, burn in enumerate(burns):
            state[3:] += burn
            if k + 1 < len(burns):
                span = self.times[k], self.times[k + 1]
                flown = solve_ivp(self._rate, span, state, method="DOP853", rtol=1e-13, atol=1e-13)
                state = flown.y[:, -1].copy()
        return float(np.abs(state - self.ends[1]).max())

    def _rate(self, t: float, state: Array) -> Array:
        return np.array([*state[3:], *self.acceleration(state[:3], state[3:], t, [self.mu])])

    def row(self, method: str) -> Record:
        """Solve by an algorithm of the planner or by scocp: a row."""
        begin = process_time()
        if method == SCOCP:
            burns, status, iterations = self._scocp()
        else:
            plan = self.problem.solve(self.guess, algorithm=method)
            burns, status, iterations = plan.burns, plan.status.value.name, plan.iterations
        return {
            "method": method,
            "status": status.replace("_", " "),
            "cost": f"{np.linalg.norm(burns, axis=1).sum():.7f}",
            "missed": self.missed(burns),
            "iterations": iterations,
            "solve_s": process_time() - begin,
        }

    def _scocp(self) -> tuple[Array, str, int]:
        """Burns, status and iterations of scocp, with its test's tolerances and limit of iterations."""
        import scocp

        n, within = len(self.nodes), {"method": "DOP853", "reltol": TOLERANCE, "abstol": TOLERANCE}
        rates = scocp.rhs_cr3bp, scocp.rhs_cr3bp_stm
        flow = scocp.ScipyIntegrator(6, 3, *rates, args=(self.mu,), **within)
        posed = scocp.FixedTimeImpulsiveRdv(*self.ends, flow, self.times)
        algorithm = scocp.SCvxStar(posed, tol_opt=1e-4, tol_feas=1e-10)
        start = self.guess[self.nodes].copy(), np.zeros((n, 3)), np.zeros((n, 1))
        found = algorithm.solve(*start, maxiter=100, verbose=False)
        told = found.summary_dict
        burns = np.full((n, 3), np.nan) if found.u is None else found.u
        status = {"Optimal": "converged"}.get(told["status"], told["status"])
        return burns, status, told["num_iter"]


def measure(method: str) -> Record:
    """The row of a method."""
    return Halo().row(method)


def run(session: Session) -> Tables:
    """Solve the transfer by all."""
    with needing("peers", "peers"):
        importlib.import_module(SCOCP)
    rows = session.rows("solves", measure, [*ALGORITHMS, SCOCP])
    return {"methods": rows}


STUDY = Study(__doc__, run)
