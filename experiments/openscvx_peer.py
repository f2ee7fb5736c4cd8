"""P3 in OpenSCvx, an outside peer: `python -m experiments.openscvx_peer`; needs the extra [peer].

Posed as its users would: symbolic dynamics with impulsive controls, the turning site as a function of
the time state, constraints at the nodes, its own algorithm (PTR) and solver (QOCO). The dynamics and
limits are the planner's; the burns that it ends with are flown by the planner's dynamics. The table
goes to OUT/openscvx_peer.csv and .md.

What its release 0.5.2 does not express, or not as the planner does:

- Chance constraints. There is no covariance state that a constraint could look at without writing its
  36 differential equations with second derivatives by hand, so that only P3 is compared.
- The size of an impulse: its derivative at the nodes without a burn, where the impulse is zero, is not
  a number. A second control bounds it from above, in the cost and in the battery's cone.
- The straight line as a guess: it leads through the body's centre, where the adaptive integration
  gives no number. Both sides start from the ballistic arc.
- The Sun's motion of 0.02 deg in the window is left out, and both phase limits are one.
"""

from __future__ import annotations

import argparse
import contextlib
import csv
import importlib.util
import io
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from time import perf_counter
from typing import Any

import numpy as np
import numpy.typing as npt
from rich.console import Console

from formulations.problem import Iterate
from scp_recon import geometry, guess
from scp_recon.command import guarded
from scp_recon.errors import InputError
from scp_recon.forces import acceleration
from scp_recon.mission import Mission
from scp_recon.planner import plan
from scp_recon.scenario import load_scenario
from scp_recon.solution import write_atomically

Array = npt.NDArray[np.float64]

DEFAULT_OUT = Path("runs") / "openscvx_peer"
STRIDE = 5
"""Of the grid's nodes outside the window every fifth is kept: fewer than its users would take, and yet
its program takes minutes to build with all of them."""

WEIGHTS = (
    {"lam_cost": 1e-2, "lam_vc": 1.0, "lam_vb": 1.0},
    {"lam_cost": 1e-1, "lam_vc": 10.0, "lam_vb": 10.0},
    {"lam_cost": 1e-2, "lam_vc": 10.0, "lam_vb": 10.0},
)
"""Weights of cost, virtual control and virtual buffer; the first are its defaults but for the buffer's,
which is zero."""

HEAD = (
    "method", "status", "delta-v m/s", "miss m", "miss m/s", "worst margin m",
    "iterations", "build s", "solve s",
)  # fmt: skip


@dataclass(frozen=True)
class Problem:
    """P3 in its words, all but the algorithm.

    Attributes:
        arguments: of `openscvx.Problem`.
        burn_nodes: among its nodes.
    """

    arguments: dict[str, Any]
    burn_nodes: npt.NDArray[np.intp]


def pose(mission: Mission, start: Iterate) -> Problem:
    """P3 of a mission on a coarser grid, nondimensional."""
    import openscvx as ox

    p, units = mission.problem, mission.units
    nodes = np.union1d(mission.window_nodes, mission.burn_nodes)
    nodes = np.union1d(nodes, np.arange(0, len(mission.times_s), STRIDE))
    times = mission.times_s[nodes]
    t, count = times / units.time_s, len(nodes)
    window = np.searchsorted(nodes, mission.window_nodes)
    burn_nodes = np.searchsorted(nodes, mission.burn_nodes)
    at = burn_nodes.tolist()

    position, velocity = ox.State("position", shape=(3,)), ox.State("velocity", shape=(3,))
    spent = ox.State("spent", shape=(1,))
    for state, part in ((position, slice(0, 3)), (velocity, slice(3, 6))):
        state.min, state.max = [-3.0] * 3, [3.0] * 3
        state.initial, state.final = p.initial_state[part], p.final_state[part]
        state.guess = start.mean[nodes, part]
    size_max = p.dv_max * p.n_burns
    spent.min, spent.max, spent.initial = [0.0], [size_max], [0.0]
    spent.final = [ox.Minimize(start.total_dv)]
    spent.guess = np.linspace(0.0, start.total_dv, count)[:, None]
    burn = ox.Control("burn", shape=(3,), parameterization="impulsive", nodes=at)
    size = ox.Control("size", shape=(1,), parameterization="impulsive", nodes=at)
    burn.min, burn.max = [-p.dv_max] * 3, [p.dv_max] * 3
    size.min, size.max = [0.0], [p.dv_max]
    burn.guess, size.guess = np.zeros((count, 3)), np.zeros((count, 1))
    burn.guess[at] = start.burns
    size.guess[at] = np.linalg.norm(start.burns, axis=1, keepdims=True)
    time = ox.Time(initial=0.0, final=float(t[-1]), min=0.0, max=float(t[-1]), guess=t)

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


def peers_row(mission: Mission, start: Iterate, weights: dict[str, float]) -> tuple[str, ...]:
    """Solve it in OpenSCvx with given weights, and fly the burns by the planner's dynamics."""
    import openscvx as ox

    begin = perf_counter()
    problem = pose(mission, start)  # anew: its variables belong to one problem
    with contextlib.redirect_stdout(io.StringIO()):  # it prints a table as it goes
        solver = ox.Problem(**problem.arguments, algorithm=dict(weights))
        solver.initialize()
        built_s, begin = perf_counter() - begin, perf_counter()
        result = solver.solve()
    solve_s = perf_counter() - begin
    burns = np.asarray(result.nodes["burn"])[problem.burn_nodes]
    words = ", ".join(f"{name} {value:g}" for name, value in weights.items())
    status = "converged" if result.converged else "not converged"
    figures = _flown(mission, burns)
    seconds = f"{built_s:.2f}", f"{solve_s:.2f}"
    return f"OpenSCvx PTR/QOCO, {words}", status, *figures, str(len(result.X) - 1), *seconds


def our_row(mission: Mission, start: Iterate, algorithm: str, solver: str) -> tuple[str, ...]:
    """P3 by the planner from the same guess."""
    done = plan(mission, start, problem="P3", algorithm=algorithm, solver=solver)
    result = done.final.result
    return (
        f"condensed/{algorithm}/{solver}",
        result.status.value.name,
        *_flown(mission, result.lin.iterate.burns),
        str(len(result.records)),
        f"{done.timing.setup:.2f}",
        f"{done.total_s:.2f}",
    )


def _flown(mission: Mission, burns: Array) -> tuple[str, str, str, str]:
    """Delta-v, miss of the final state and smallest margin of P3 on the planner's grid."""
    p, units = mission.problem, mission.units
    mean = mission.dynamics.rollout(p.initial_state, burns)
    miss = mean[-1] - p.final_state
    margin = min(float(c.margin(mean).min()) for c in p.constraints)
    return (
        f"{np.linalg.norm(burns, axis=1).sum() * units.speed_m_s:.6f}",
        f"{np.linalg.norm(miss[:3]) * units.length_m:.1e}",
        f"{np.linalg.norm(miss[3:]) * units.speed_m_s:.1e}",
        f"{margin * units.length_m:.2f}",
    )


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command line."""
    p = argparse.ArgumentParser(prog="python -m experiments.openscvx_peer")
    p.add_argument("--out", type=Path, default=DEFAULT_OUT, metavar="DIR")
    options = p.parse_args(arguments)
    return guarded(lambda console: _run(options.out, console))


def _run(out: Path, console: Console) -> int:
    mission = Mission.from_scenario(load_scenario())
    start = guess.ballistic(mission)
    if importlib.util.find_spec("openscvx") is None:
        raise InputError("the peer", "no OpenSCvx", "install the extra scp_recon[peer]")
    rows = [
        our_row(mission, start, "scvx", "CLARABEL"),
        our_row(mission, start, "ptr", "QOCO"),
        *(peers_row(mission, start, weights) for weights in WEIGHTS),
    ]
    text = io.StringIO()
    csv.writer(text, lineterminator="\n").writerows([HEAD, *rows])
    table = "".join(f"| {' | '.join(line)} |\n" for line in (HEAD, ["---"] * len(HEAD), *rows))
    console.print(table, highlight=False, soft_wrap=True)
    out.mkdir(parents=True, exist_ok=True)
    for name, content in {"openscvx_peer.csv": text.getvalue(), "openscvx_peer.md": table}.items():
        console.print(f"written: {write_atomically(out / name, content)}", highlight=False)
    return 0


if __name__ == "__main__":
    sys.exit(main())
