"""Pose impulsive transfers in OpenSCvx (0.5.2) as its users would: the halo transfer, and P3.

The dynamics are symbolic, the burns are OpenSCvx's impulsive controls, and the times of the nodes
are fixed states. It cannot express the following, or not as the planner does:

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
import io
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from formulations.arrays import Array, Indices
from formulations.problem.flyby import Iterate
from scp_recon.mission.mission import Mission
from scp_recon.physics import geometry
from scp_recon.physics.forces import acceleration


@dataclass(frozen=True)
class Settings:
    """Its settings: tolerance of the integration, relative and absolute, and the algorithm's options.

    By default `lam_cost` is 0.01, `lam_vc` 1, `lam_vb` 0 (weights of cost, virtual control and virtual
    buffer), and `ep_tr`, the size of a step at which it stops, 1e-4.
    """

    tolerance: float
    lam_cost: float = 1e-2
    lam_vc: float = 1.0
    lam_vb: float = 1.0
    ep_tr: float = 1e-4
    iterations: int = 200

    def __str__(self) -> str:
        """Tolerance and weights."""
        weights = (self.lam_cost, self.lam_vc, self.lam_vb, self.ep_tr)
        return f"OpenSCvx, {self.tolerance:g}, ptr " + " ".join(f"{x:g}" for x in weights)


@dataclass(frozen=True)
class Transfer:
    """A transfer by impulses in its words; nondimensional.

    Attributes:
        times: of the nodes, shape (n,).
        burn_nodes: nodes with burns, shape (m,).
        start, goal: states before the first and after the last burn, shape (6,).
        dv_max: largest component, and size, of a burn.
        acceleration: three components, of its states of position, velocity and time.
        constraints: further ones, of position, burn, its size, and time.
    """

    times: Array
    burn_nodes: Indices
    start: Array
    goal: Array
    dv_max: float
    acceleration: Callable[[Any, Any, Any], Sequence[Any]]
    constraints: Callable[[Any, Any, Any, Any], Sequence[Any]] = lambda *_: ()


@dataclass(frozen=True)
class Answer:
    """Its burns, shape (m, 3), whether it says that it converged, and its iterations."""

    burns: Array
    converged: bool
    iterations: int


class Solver:
    """A transfer posed and compiled, which takes most of the time; solved from guess after guess."""

    def __init__(self, transfer: Transfer, settings: Settings, guess: Array, burns: Array) -> None:
        import openscvx as ox

        own, t, n = transfer, transfer.times, len(transfer.times)
        self._at, self._iterations = own.burn_nodes.tolist(), settings.iterations
        position, velocity = ox.State("position", shape=(3,)), ox.State("velocity", shape=(3,))
        spent, time = ox.State("spent", shape=(1,)), _time(ox, t)
        burn, size = (
            ox.Control(name, shape=(k,), parameterization="impulsive", nodes=self._at)
            for name, k in (("burn", 3), ("size", 1))
        )
        self._variables = position, velocity, spent, burn, size
        for state, part in ((position, slice(0, 3)), (velocity, slice(3, 6))):
            state.min, state.max = [-3.0] * 3, [3.0] * 3
            state.initial, state.final = own.start[part], own.goal[part]
        spent.min, spent.max, spent.initial = [0.0], [own.dv_max * len(self._at)], [0.0]
        spent.final = [ox.Minimize(float(np.linalg.norm(burns, axis=1).sum()))]
        burn.min, burn.max = [-own.dv_max] * 3, [own.dv_max] * 3
        size.min, size.max = [0.0], [own.dv_max]
        self._guess(guess, burns)
        held = [(time[0] == float(t[k])).convex().at([k]) for k in range(1, n - 1)]
        bounds = [(ox.linalg.Norm(burn) <= size[0]).convex().at([k]) for k in self._at]
        weights = {
            name: getattr(settings, name) for name in ("lam_cost", "lam_vc", "lam_vb", "ep_tr")
        }
        tolerance = {"rtol": settings.tolerance, "atol": settings.tolerance}
        with contextlib.redirect_stdout(io.StringIO()):  # it prints a table as it goes
            self._problem = ox.Problem(
                dynamics={
                    "position": velocity,
                    "velocity": ox.Concat(*own.acceleration(position, velocity, time)),
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
                constraints=[*held, *bounds, *own.constraints(position, burn, size, time)],
                N=n,
                float_dtype="float64",
                algorithm=weights,
                discretizer={"diffrax_kwargs": tolerance},
            )
            self._problem.initialize()

    def _guess(self, states: Array, burns: Array) -> None:
        position, velocity, spent, burn, size = self._variables
        n, sizes = len(states), np.linalg.norm(burns, axis=1, keepdims=True)
        position.guess, velocity.guess = states[:, :3], states[:, 3:]
        spent.guess = np.linspace(0.0, sizes.sum(), n)[:, None]
        burn.guess, size.guess = np.zeros((n, 3)), np.zeros((n, 1))
        burn.guess[self._at], size.guess[self._at] = burns, sizes

    def solve(self, states: Array, burns: Array) -> Answer:
        """Solve from states at the nodes, shape (n, 6), and burns, shape (m, 3)."""
        self._guess(states, burns)
        with contextlib.redirect_stdout(io.StringIO()):
            self._problem.reset()
            found = self._problem.solve(max_iters=self._iterations)
        burns = np.asarray(found.nodes["burn"])[self._at]
        return Answer(burns, bool(found.converged), self._problem.state.k - 1)


def _time(ox: Any, times: Array) -> Any:
    """Time, which is a state; it passes the nodes at `times`."""
    end = float(times[-1])
    # Its default asks arcs of at least three tenths of the mean, which the window's are not.
    shortest = 0.5 * float(np.diff(times).min()) * (len(times) - 1)
    bound = min(shortest, 0.3 * end)
    return ox.Time(initial=0.0, final=end, min=0.0, max=end, guess=times, time_dilation_min=bound)


# --- P3 -------------------------------------------------------------------------------------------


def p3(mission: Mission, nodes: Indices) -> Transfer:
    """P3 of a mission on some nodes of its grid, those of window and burns among them."""
    problem, units = mission.problem, mission.units
    times_s, window = mission.times_s[nodes], np.searchsorted(nodes, mission.window_nodes)
    burn_nodes, limit = np.searchsorted(nodes, mission.burn_nodes), float(np.cos(problem.dv_cone))
    forces = mission.forces.in_units(units.length_m, units.time_s)

    def constraints(position: Any, burn: Any, size: Any, time: Any) -> list[Any]:
        """Burns outside the battery's double cone: their part along the Sun line below its cosine."""
        import openscvx as ox

        cones = [
            (sign * ox.Sum(burn * sun) <= limit * size[0]).convex().at([k])
            for k, sun in zip(burn_nodes.tolist(), problem.sun, strict=True)
            for sign in (1.0, -1.0)
        ]
        return [*cones, *_observed(ox, mission, position, time, times_s, window.tolist())]

    return Transfer(
        times_s / units.time_s,
        burn_nodes,
        problem.initial_state,
        problem.final_state,
        problem.dv_max,
        lambda r, *_: acceleration(r[0], r[1], r[2], forces),
        constraints,
    )


def nodes_of(mission: Mission, stride: int) -> Indices:
    """Of the nodes outside the window every so many-th, and those of burns."""
    kept = np.union1d(mission.window_nodes, mission.burn_nodes)
    return np.union1d(kept, np.arange(0, len(mission.times_s), stride))


def solve_p3(mission: Mission, start: Iterate, stride: int, settings: Settings) -> Answer:
    """Solve P3 on every so many-th node."""
    nodes = nodes_of(mission, stride)
    guess = start.mean[nodes], start.burns
    return Solver(p3(mission, nodes), settings, *guess).solve(*guess)


def _observed(
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

    safe = mission.scenario.safety.radius_min_m / length
    return [
        (ox.linalg.Norm(position) >= safe).at(list(range(len(times_s)))),
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
