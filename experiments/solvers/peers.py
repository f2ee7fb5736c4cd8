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

OpenSCvx 0.5.2 is used as its users would: symbolic dynamics, impulsive controls, the nodes' times as
fixed states. It cannot express the following, or not as the planner does:

- Chance constraints. A covariance state would need its 36 differential equations with second
  derivatives written by hand, so only P3 is compared.
- The size of an impulse: its derivative at the nodes without a burn, where the impulse is zero, is not
  a number. A second control bounds it from above, in the cost and in the battery's cone.
- The straight line as a guess for P3: it leads through the body's centre, where the adaptive
  integration fails. Both sides start from the ballistic arc. The Sun's motion of 0.02 deg in the
  window is left out, and both phase limits are one.
"""

from __future__ import annotations

import contextlib
import importlib
import io
import runpy
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from time import process_time
from typing import Any, NamedTuple

import numpy as np
import pandas as pd
from scipy.integrate import solve_ivp

from experiments.harness import Findings, Record, Session, Study, records
from experiments.solvers.cells import rolled_out
from formulations.arrays import Array, Indices
from formulations.problem.flyby import Iterate
from formulations.program.subproblem import MeritFunction
from formulations.registry import FORMULATIONS
from formulations.rows.uniform import DeterministicRows
from scp_recon.api.options import PlanOptions
from scp_recon.api.planning import plan_mission
from scp_recon.errors import needing
from scp_recon.impulsive.problem import ImpulsiveProblem
from scp_recon.mission.mission import Mission
from scp_recon.monte_carlo.estimates import proportion
from scp_recon.physics import geometry
from scp_recon.physics.forces import acceleration
from scp_recon.planning import initial_guess
from scp_recon.scenario.load import load_scenario
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
STRIDE = 5
"""OpenSCvx has so many-th nodes of P3 outside the window."""
P3_CASES = (WEIGHTS[0], Settings(1e-10, 0.1, 10.0, 10.0, 1e-6), WEIGHTS[2])
GUESSED: tuple[Method, ...] = (*OURS[:4], "scocp", WEIGHTS[1])
HALO, P3 = "halo transfer", "P3"


class Answer(NamedTuple):
    """A tool's burns, shape (m, 3), its status, iterations and seconds of the processor."""

    burns: Array
    status: str
    iterations: int
    solve_s: float
    set_up_s: float = 0.0

    def row(self, problem: str, method: Method, cost: float, missed: float) -> Record:
        """A row of the tables."""
        return {
            "problem": problem,
            "method": str(method) if isinstance(method, str | Settings) else "/".join(method),
            "status": self.status.replace("_", " "),
            "cost": cost,
            "missed": missed,
            "iterations": self.iterations,
            "set_up_s": self.set_up_s,
            "solve_s": self.solve_s,
        }


class OpenScvx:
    """A transfer by impulses, posed and compiled in OpenSCvx; nondimensional.

    Args:
        settings: of the tool.
        times: of the nodes, shape (n,).
        burn_nodes: nodes with burns, shape (m,).
        ends: states before the first and after the last burn, shape (6,) each.
        dv_max: largest component, and size, of a burn.
        guess: states at the nodes, shape (n, 6), and burns, shape (m, 3).
        rate: three components of the acceleration, of its position, velocity and time.
        constraints: further ones, of position, burn, its size, and time.
    """

    def __init__(
        self,
        settings: Settings,
        times: Array,
        burn_nodes: Indices,
        ends: tuple[Array, Array],
        dv_max: float,
        guess: tuple[Array, Array],
        rate: Callable[[Any, Any, Any], Sequence[Any]],
        constraints: Callable[[Any, Any, Any, Any], Sequence[Any]] = lambda *_: (),
    ) -> None:
        import openscvx as ox

        begin, n, end = process_time(), len(times), float(times[-1])
        self._at = burn_nodes.tolist()
        position, velocity = ox.State("position", shape=(3,)), ox.State("velocity", shape=(3,))
        spent = ox.State("spent", shape=(1,))
        burn, size = (
            ox.Control(name, shape=(k,), parameterization="impulsive", nodes=self._at)
            for name, k in (("burn", 3), ("size", 1))
        )
        self._variables = position, velocity, spent, burn, size
        for state, part in ((position, slice(0, 3)), (velocity, slice(3, 6))):
            state.min, state.max = [-3.0] * 3, [3.0] * 3
            state.initial, state.final = (one[part] for one in ends)
        spent.min, spent.max, spent.initial = [0.0], [dv_max * len(self._at)], [0.0]
        spent.final = [ox.Minimize(float(np.linalg.norm(guess[1], axis=1).sum()))]
        burn.min, burn.max, size.min, size.max = [-dv_max] * 3, [dv_max] * 3, [0.0], [dv_max]
        self._guess(*guess)
        # By default arcs have three tenths of the mean at least, which those of the window have not.
        least = min(0.5 * float(np.diff(times).min()) * (n - 1), 0.3 * end)
        bounds = {"min": 0.0, "max": end, "time_dilation_min": least}
        time = ox.Time(initial=0.0, final=end, guess=times, **bounds)
        fixed = [(time[0] == float(times[k])).convex().at([k]) for k in range(1, n - 1)]
        sizes = [(ox.linalg.Norm(burn) <= size[0]).convex().at([k]) for k in self._at]
        algorithm = settings._asdict()
        tolerance = algorithm.pop("tolerance")
        with contextlib.redirect_stdout(io.StringIO()):  # it prints a table as it goes
            self._problem = ox.Problem(
                dynamics={
                    "position": velocity,
                    "velocity": ox.Concat(*rate(position, velocity, time)),
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
                constraints=[*fixed, *sizes, *constraints(position, burn, size, time)],
                N=n,
                float_dtype="float64",
                algorithm=algorithm,
                discretizer={"diffrax_kwargs": {"rtol": tolerance, "atol": tolerance}},
            )
            self._problem.initialize()
        self.set_up_s = process_time() - begin

    def _guess(self, states: Array, burns: Array) -> None:
        position, velocity, spent, burn, size = self._variables
        n, sizes = len(states), np.linalg.norm(burns, axis=1, keepdims=True)
        position.guess, velocity.guess = states[:, :3], states[:, 3:]
        spent.guess = np.linspace(0.0, sizes.sum(), n)[:, None]
        burn.guess, size.guess = np.zeros((n, 3)), np.zeros((n, 1))
        burn.guess[self._at], size.guess[self._at] = burns, sizes

    def solve(self, states: Array, burns: Array) -> Answer:
        """Solve from states at the nodes, shape (n, 6), and burns, shape (m, 3)."""
        begin = process_time()
        self._guess(states, burns)
        with contextlib.redirect_stdout(io.StringIO()):
            self._problem.reset()
            found = self._problem.solve(max_iters=ITERATIONS)
        seconds, burns = process_time() - begin, np.asarray(found.nodes["burn"])[self._at]
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
        return found.row(HALO, method, cost, self.missed(found.burns)) | {"seed": seed}

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
        none = np.zeros((len(guess), 3))
        if settings not in self._compiled:
            self._compiled[settings] = OpenScvx(
                settings,
                self.times[self.nodes],
                np.arange(len(guess)),
                self.ends,
                self.problem.dv_max,
                (guess, none),
                lambda r, v, t: self.acceleration(r, v, t, [self.mu]),
            )
        return self._compiled[settings].solve(guess, none)


# --- P3 -------------------------------------------------------------------------------------------


def p3_row(mission: Mission, start: Iterate, algorithm: str, solver: str) -> Record:
    """P3 by the planner."""
    options, begin = PlanOptions(problem="P3", algorithm=algorithm, solver=solver), process_time()
    done = plan_mission(mission, start, options)
    seconds, result = process_time() - begin, done.final.result
    iterations = sum(len(stage.result.records) for stage in done.stages)
    found = Answer(result.lin.iterate.burns, result.status.value.name, iterations, seconds)
    return _judged(mission, f"condensed/{algorithm}/{solver}", found)


def _judged(mission: Mission, method: str, found: Answer) -> Record:
    """Of burns flown on the planner's grid: delta-v, m/s, and the worst violation, m."""
    lin = rolled_out(mission, found.burns)
    merit = MeritFunction(mission.problem, DeterministicRows(mission.problem))
    missed = merit.worst_violation(lin) * mission.units.length_m
    return found.row(P3, method, lin.iterate.total_dv * mission.units.speed_m_s, missed)


def p3_peer(mission: Mission, start: Iterate, settings: Settings) -> Record:
    """P3 by OpenSCvx on every so many-th node, and on those of the window and of burns."""
    problem, units, begin = mission.problem, mission.units, process_time()
    kept = np.union1d(mission.window_nodes, mission.burn_nodes)
    nodes = np.union1d(kept, np.arange(0, len(mission.times_s), STRIDE))
    times_s, burn_nodes = mission.times_s[nodes], np.searchsorted(nodes, mission.burn_nodes)
    window = np.searchsorted(nodes, mission.window_nodes).tolist()
    forces = mission.forces.in_units(units.length_m, units.time_s)

    def constraints(position: Any, burn: Any, size: Any, time: Any) -> list[Any]:
        """The battery's double cone: the part of a burn along the Sun line is below its cosine."""
        import openscvx as ox

        limit = float(np.cos(problem.dv_cone))
        cones = [
            (sign * ox.Sum(burn * sun) <= limit * size[0]).convex().at([k])
            for k, sun in zip(burn_nodes.tolist(), problem.sun, strict=True)
            for sign in (1.0, -1.0)
        ]
        return [*cones, *_observed(mission, position, time, times_s, window)]

    guess = start.mean[nodes], start.burns
    solver = OpenScvx(
        settings,
        times_s / units.time_s,
        burn_nodes,
        (problem.initial_state, problem.final_state),
        problem.dv_max,
        guess,
        lambda r, *_: acceleration(r[0], r[1], r[2], forces),
        constraints,
    )
    found = solver.solve(*guess)._replace(solve_s=process_time() - begin, set_up_s=0.0)
    return _judged(mission, f"{settings}, every {STRIDE}th node", found)


def _observed(
    mission: Mission, position: Any, time: Any, times_s: Array, window: list[int]
) -> list[Any]:
    """Safety at every node, the observation in the window; the site turns with the time state."""
    import openscvx as ox

    limits, length, unit = (
        mission.scenario.observation,
        mission.units.length_m,
        mission.units.time_s,
    )
    angle = mission.rotation.rate * times_s
    basis = np.stack([np.ones_like(angle), np.cos(angle), np.sin(angle)], axis=1)

    def turning(values: Array) -> Any:
        """A vector fixed in the body, (n, 3) at the nodes, as an expression of the time state."""
        fixed, cosine, sine = np.linalg.lstsq(basis, values)[0]
        turned = mission.rotation.rate * unit * time[0]
        return fixed + ox.Cos(turned) * cosine + ox.Sin(turned) * sine

    track = geometry.track(mission.site, mission.rotation, times_s)
    sun = mission.sun_direction(times_s[window]).mean(axis=0)
    offset = position - turning(track.position / length)
    distance = ox.linalg.Norm(offset)
    emission = ox.Sum(offset * turning(track.normal)) / distance
    phase = ox.Sum(offset * sun) / distance
    widest = max(limits.phase_min_deg, mission.scenario.battery.observation_cone_deg)
    steep, flat, lit = np.cos(
        np.deg2rad([limits.emission_min_deg, limits.emission_max_deg, widest])
    ).tolist()
    safe = mission.scenario.safety.radius_min_m / length
    return [
        (ox.linalg.Norm(position) >= safe).at(list(range(len(times_s)))),
        (distance >= limits.site_distance_min_m / length).at(window),
        (distance <= limits.site_distance_max_m / length).at(window),
        (emission <= steep).at(window),
        (emission >= flat).at(window),
        (phase <= lit).at(window),
    ]


# --- the study ------------------------------------------------------------------------------------


def run(session: Session) -> Findings:
    """Solve both problems by all, then the transfer from the other guesses."""
    with needing("peers", "peers"):
        for name in ("openscvx", "scocp"):
            importlib.import_module(name)
    halo, mission = Halo(), Mission.from_scenario(load_scenario())
    start = initial_guess.ballistic(mission)
    every: tuple[Method, ...] = (*OURS, "scocp", *WEIGHTS)
    solves = {f"{HALO}|{method}": partial(halo.row, method) for method in every}
    for of in (("scvx", "CLARABEL"), ("ptr", "QOCO")):
        solves[f"{P3}|{of}"] = partial(p3_row, mission, start, *of)
    for case in P3_CASES:
        solves[f"{P3}|{case}"] = partial(p3_peer, mission, start, case)
    for seed in range(SEEDS):
        for method in GUESSED:
            solves[f"{method}|{seed}"] = partial(halo.row, method, seed)
    rows = session.rows("solves", lambda key: solves[key](), solves, session.store())
    once = [
        {name: row[name] for name in row if name != "seed"}
        | {"cost": f"{row['cost']:.{7 if row['problem'] == HALO else 6}f}"}
        for row in rows
        if row.get("seed") is None
    ]
    bent = [row for row in rows if row.get("seed") is not None]
    return Findings({"methods.csv": records(once), "guesses.csv": records(guesses(bent))})


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
