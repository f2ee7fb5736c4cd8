"""Solve P3 with OpenSCvx, an independent tool; needs the extra [peer].

OpenSCvx's algorithm (PTR) and solver (QOCO) solve P3; the resulting burns are flown by the planner's
dynamics, and judged on the planner's grid like the planner's own. The rows go to OUT, from where
`compare_solvers` takes them into its table and CSV.

P3 is posed as its users would: symbolic dynamics with impulsive controls, the turning site as a
function of the time state, constraints at the nodes. Dynamics and limits are the planner's.

Release 0.5.2 cannot express the following, or not as the planner does:

- Chance constraints. A covariance state would need its 36 differential equations with second
  derivatives written by hand, so only P3 is compared.
- The size of an impulse: its derivative at the nodes without a burn, where the impulse is zero, is not
  a number. A second control bounds it from above, in the cost and in the battery's cone.
- The straight line as a guess: it leads through the body's centre, where the adaptive integration
  gives no number. Both sides start from the ballistic arc.
- The Sun's motion of 0.02 deg in the window is left out, and both phase limits are one.
"""

from __future__ import annotations

import contextlib
import importlib.util
import io
from collections.abc import Callable
from dataclasses import asdict, dataclass, replace
from functools import partial
from time import perf_counter, process_time
from typing import Any

import numpy as np

from experiments.compare_solvers.cases import Cell, Method
from experiments.compare_solvers.cell import Row, empty_row, judged
from experiments.compare_solvers.exact.check import rolled_out
from experiments.compare_solvers.study import DEFAULT_OUT, PEER_FILE, row_from, version
from experiments.compare_solvers.tables import peer_table
from experiments.harness import Findings, Record, Session, Study
from formulations.arrays import Array, Indices
from formulations.problem.flyby import Iterate
from formulations.program.subproblem import MeritFunction
from formulations.rows.uniform import DeterministicRows
from scp_recon.api.options import PlanOptions
from scp_recon.api.planning import plan_mission
from scp_recon.errors import InputError
from scp_recon.jobs.job import Job
from scp_recon.mission.mission import Mission
from scp_recon.physics import geometry
from scp_recon.physics.forces import acceleration
from scp_recon.planning import initial_guess
from scp_recon.scenario.load import load_scenario

FLIGHTS = 2_000


@dataclass(frozen=True)
class Case:
    """Settings of OpenSCvx.

    Attributes:
        stride: of the grid's nodes outside the window that are kept.
        tolerance: of its integration, relative and absolute; None for its defaults, 1e-6 and 1e-3.
        lam_cost, lam_vc, lam_vb: weights of cost, virtual control and virtual buffer. The first two
            are 0.01 and 1 by default, the buffer's is zero.
        ep_tr: size of a step at which it stops, 1e-4 by default.
    """

    stride: int
    tolerance: float | None
    lam_cost: float
    lam_vc: float
    lam_vb: float
    ep_tr: float = 1e-4

    @property
    def algorithm(self) -> dict[str, float]:
        """Options of its algorithm."""
        names = ("lam_cost", "lam_vc", "lam_vb", "ep_tr")
        return {name: getattr(self, name) for name in names}

    @property
    def method(self) -> Method:
        """Name of the method in the table."""
        nodes = "every node" if self.stride == 1 else f"every {self.stride}th node"
        tolerance = "default" if self.tolerance is None else f"{self.tolerance:g}"
        weights = " ".join(f"{value:g}" for value in self.algorithm.values())
        return Method(f"OpenSCvx, {nodes}, tolerance {tolerance}", f"ptr {weights}", "QOCO")


CASES = (
    Case(5, None, 1e-2, 1.0, 1.0),
    Case(5, 1e-10, 1e-2, 1.0, 1.0),
    Case(5, 1e-10, 1e-1, 10.0, 10.0),
    Case(5, 1e-10, 1e-1, 10.0, 10.0, ep_tr=1e-6),
    Case(1, 1e-10, 1e-1, 10.0, 10.0),
)


def peers_row(mission: Mission, start: Iterate, case: Case) -> Row:
    """Solve P3 with OpenSCvx, and fly its burns by the planner's dynamics."""
    import openscvx as ox

    begin, cpu_begin = perf_counter(), process_time()
    problem = pose(mission, start, case.stride)  # anew: its variables belong to one problem
    options: dict[str, Any] = {"algorithm": case.algorithm}
    if case.tolerance is not None:
        within = {"rtol": case.tolerance, "atol": case.tolerance}
        options["discretizer"] = {"diffrax_kwargs": within}
    with contextlib.redirect_stdout(io.StringIO()):  # it prints a table as it goes
        solver = ox.Problem(**problem.arguments, **options)
        solver.initialize()
        result = solver.solve()
    row = replace(
        _row(mission, case.method, np.asarray(result.nodes["burn"])[problem.burn_nodes]),
        status="converged" if result.converged else "not converged",
        iterations_p3=len(result.X) - 1,
    )
    return replace(row, total_s=perf_counter() - begin, cpu_s=process_time() - cpu_begin)


def our_row(mission: Mission, start: Iterate, algorithm: str, solver: str) -> Row:
    """P3 by the planner from the same guess."""
    begin = process_time()
    options = PlanOptions(problem="P3", algorithm=algorithm, solver=solver)
    done = plan_mission(mission, start, options)
    cpu_s, result = process_time() - begin, done.final.result
    return replace(
        _row(mission, Method("condensed", algorithm, solver), result.lin.iterate.burns),
        status=result.status.value.name,
        iterations_p3=len(result.records),
        total_s=done.total_s,
        cpu_s=cpu_s,
        solver_s=done.timing.conic_solver,
    )


def _row(mission: Mission, method: Method, burns: Array) -> Row:
    """Judge flown burns by P3 on the planner's grid: their cost and violation."""
    row = replace(
        empty_row(Cell("matrix", "recon_b", (), method, "warm")),
        key=f"peer|{method.name}",
        group="peer",
        limit_s=np.inf,
        version=version(),
    )
    merit = MeritFunction(mission.problem, DeterministicRows(mission.problem))
    return judged(row, mission, rolled_out(mission, burns), merit, FLIGHTS)


# --- P3 in its words -------------------------------------------------------------------------------


@dataclass(frozen=True)
class Problem:
    """Arguments of `openscvx.Problem`, all but the algorithm, and which of its nodes have burns."""

    arguments: dict[str, Any]
    burn_nodes: Indices


def pose(mission: Mission, start: Iterate, stride: int) -> Problem:
    """P3 of a mission, nondimensional; of the nodes outside the window every `stride`-th is kept."""
    import openscvx as ox

    units = mission.units
    nodes = np.union1d(mission.window_nodes, mission.burn_nodes)
    nodes = np.union1d(nodes, np.arange(0, len(mission.times_s), stride))
    times = mission.times_s[nodes]
    t, count = times / units.time_s, len(nodes)
    window = np.searchsorted(nodes, mission.window_nodes)
    burn_nodes = np.searchsorted(nodes, mission.burn_nodes)
    at = burn_nodes.tolist()

    position, velocity, spent = _states(ox, mission, start, nodes)
    burn, size = _impulses(ox, mission, start, count, at)
    time = _time(ox, t)
    constraints = [
        *((time[0] == float(t[k])).convex().at([k]) for k in range(1, count - 1)),
        *((ox.linalg.Norm(burn) <= size[0]).convex().at([k]) for k in at),
        *_burn_cones(ox, mission, burn, size, at),
        *_state_constraints(ox, mission, position, time, times, window.tolist()),
    ]
    forces = mission.forces.in_units(units.length_m, units.time_s)
    pull = acceleration(position[0], position[1], position[2], forces)
    return Problem(
        {
            "dynamics": {
                "position": velocity,
                "velocity": ox.Concat(*pull),
                "spent": ox.Constant(np.zeros(1)),
            },
            "dynamics_discrete": {
                "position": position,
                "velocity": velocity + burn,
                "spent": spent + size,
            },
            "states": [position, velocity, spent],
            "controls": [burn, size],
            "time": time,
            "constraints": constraints,
            "N": count,
            "float_dtype": "float64",
        },
        burn_nodes,
    )


def _states(ox: Any, mission: Mission, start: Iterate, nodes: Indices) -> list[Any]:
    """Position, velocity, and the delta-v spent, whose end is the cost."""
    p = mission.problem
    position, velocity = ox.State("position", shape=(3,)), ox.State("velocity", shape=(3,))
    spent = ox.State("spent", shape=(1,))
    for state, part in ((position, slice(0, 3)), (velocity, slice(3, 6))):
        state.min, state.max = [-3.0] * 3, [3.0] * 3
        state.initial, state.final = p.initial_state[part], p.final_state[part]
        state.guess = start.mean[nodes, part]
    spent.min, spent.max, spent.initial = [0.0], [p.dv_max * p.n_burns], [0.0]
    spent.final = [ox.Minimize(start.total_dv)]
    spent.guess = np.linspace(0.0, start.total_dv, len(nodes))[:, None]
    return [position, velocity, spent]


def _impulses(ox: Any, mission: Mission, start: Iterate, count: int, at: list[int]) -> list[Any]:
    """The burns, and the bounds on their sizes."""
    dv_max = mission.problem.dv_max
    burn = ox.Control("burn", shape=(3,), parameterization="impulsive", nodes=at)
    size = ox.Control("size", shape=(1,), parameterization="impulsive", nodes=at)
    burn.min, burn.max = [-dv_max] * 3, [dv_max] * 3
    size.min, size.max = [0.0], [dv_max]
    burn.guess, size.guess = np.zeros((count, 3)), np.zeros((count, 1))
    burn.guess[at] = start.burns
    size.guess[at] = np.linalg.norm(start.burns, axis=1, keepdims=True)
    return [burn, size]


def _time(ox: Any, times: Array) -> Any:
    """Time, which is a state; it passes the nodes at `times`."""
    end = float(times[-1])
    # Its default asks arcs of at least three tenths of the mean, which the window's are not.
    shortest = 0.5 * float(np.diff(times).min()) * (len(times) - 1)
    return ox.Time(
        initial=0.0,
        final=end,
        min=0.0,
        max=end,
        guess=times,
        time_dilation_min=min(shortest, 0.3 * end),
    )


def _burn_cones(ox: Any, mission: Mission, burn: Any, size: Any, at: list[int]) -> list[Any]:
    """Burns outside the battery's double cone: their part along the Sun line below its cosine."""
    p = mission.problem
    limit = float(np.cos(p.dv_cone))
    return [
        (sign * ox.Sum(burn * sun) <= limit * size[0]).convex().at([k])
        for k, sun in zip(at, p.sun, strict=True)
        for sign in (1.0, -1.0)
    ]


def _state_constraints(
    ox: Any, mission: Mission, position: Any, time: Any, times_s: Array, window: list[int]
) -> list[Any]:
    """Safety at every node, the observation in the window; the site turns with the time state."""
    limits, length = mission.scenario.observation, mission.units.length_m
    track = geometry.track(mission.site, mission.rotation, times_s)
    site = _turning(ox, mission, track.position / length, time, times_s)
    normal = _turning(ox, mission, track.normal, time, times_s)
    sun = mission.sun_direction(times_s[window]).mean(axis=0)
    offset = position - site
    distance = ox.linalg.Norm(offset)
    emission, phase = ox.Sum(offset * normal) / distance, ox.Sum(offset * sun) / distance
    widest = max(limits.phase_min_deg, mission.scenario.battery.observation_cone_deg)

    def cosine(angle_deg: float) -> float:
        return float(np.cos(np.deg2rad(angle_deg)))

    everywhere = list(range(len(times_s)))
    safe = mission.scenario.safety.radius_min_m / length
    return [
        (ox.linalg.Norm(position) >= safe).at(everywhere),
        (distance >= limits.site_distance_min_m / length).at(window),
        (distance <= limits.site_distance_max_m / length).at(window),
        (emission <= cosine(limits.emission_min_deg)).at(window),
        (emission >= cosine(limits.emission_max_deg)).at(window),
        (phase <= cosine(widest)).at(window),
    ]


def _turning(ox: Any, mission: Mission, values: Array, time: Any, times_s: Array) -> Any:
    """A vector fixed in the body, (n, 3) at given times, as an expression of the time state."""
    unit = mission.units.time_s
    rate = mission.rotation.rate * unit
    angle = rate * times_s / unit
    basis = np.stack([np.ones_like(angle), np.cos(angle), np.sin(angle)], axis=1)
    fixed, cosine, sine = np.linalg.lstsq(basis, values)[0]
    return fixed + ox.Cos(rate * time[0]) * cosine + ox.Sin(rate * time[0]) * sine


def run(session: Session) -> Findings:
    """Solve every case by the peer, and P3 by the planner from the same start."""
    mission = Mission.from_scenario(load_scenario())
    start = initial_guess.ballistic(mission)
    if importlib.util.find_spec("openscvx") is None:
        raise InputError("the peer", "no OpenSCvx", "install the extra scp_recon[peer]")
    solves = (
        partial(our_row, mission, start, "scvx", "CLARABEL"),
        partial(our_row, mission, start, "ptr", "QOCO"),
        *(partial(peers_row, mission, start, case) for case in CASES),
    )
    jobs = [Job(number, solve) for number, solve in enumerate(solves)]
    rows = session.rows("methods", _called, jobs, session.store(PEER_FILE), line=_line)
    table = peer_table([row_from(row) for row in rows])
    return Findings([table], {"openscvx_peer.csv": table})


def _called(solve: Callable[[], Row]) -> Record:
    return asdict(solve())


def _line(row: Record) -> str:
    return f"{row_from(row).method}: {row['status']}"


STUDY = Study(
    "P3 by OpenSCvx",
    __doc__,
    run,
    folder=DEFAULT_OUT.name,
    stem="peer",
)
