"""Small random flybys, with arcs whose derivatives are known in closed form."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TypeVar

import numpy as np
import pytest
from hypothesis import settings
from hypothesis import strategies as st

from formulations.arrays import Array
from formulations.linearisation.linearisation import Linearisation
from formulations.problem.controls import Cost, Feedback
from formulations.problem.execution_errors import ComponentwiseErrors
from formulations.problem.flyby import FlybyProblem, Iterate, StateConstraint
from formulations.problem.regions import Ball, Cone
from formulations.rows.uniform import ChanceRows, DeterministicRows

T = TypeVar("T")


MANY = 100
"""Examples of a profile from which it is one that looks harder than a usual run."""


def share_of_examples(divisor: int, usual: int | None = None) -> int:
    """Examples of a property that takes its time: a fraction of the profile's.

    Args:
        divisor: of the profile's number.
        usual: instead, in the profiles of usual runs, where one example takes seconds.
    """
    most = settings().max_examples
    return usual if usual is not None and most < MANY else max(1, most // divisor)


def usually(cases: Sequence[T], count: int) -> Sequence[T]:
    """So many of the cases in usual runs, all of them in those that look harder."""
    return cases if settings().max_examples >= MANY else cases[:count]


nightly = pytest.mark.skipif(settings().max_examples < MANY, reason="runs in make nightly")
"""Marks a test that takes long, and whose likeness runs every day."""

generators = st.integers(0, 2**32 - 1).map(np.random.default_rng)
"""Random generators for what is built rather than drawn."""


@st.composite
def unit_vectors(draw: st.DrawFn) -> Array:
    """Directions, by height and azimuth."""
    z, azimuth = draw(st.floats(-1.0, 1.0)), draw(st.floats(-np.pi, np.pi))
    across = np.sqrt(1.0 - z * z)
    return np.array([across * np.cos(azimuth), across * np.sin(azimuth), z])


def random_unit(rng: np.random.Generator, *shape: int) -> Array:
    vector = rng.normal(size=(*shape, 3))
    return vector / np.linalg.norm(vector, axis=-1, keepdims=True)


def random_rotation(rng: np.random.Generator) -> Array:
    q, _ = np.linalg.qr(rng.normal(size=(3, 3)))
    return q * np.linalg.det(q)


@dataclass(frozen=True)
class Arcs:
    """End states, STMs and second-order tensors."""

    state: Array
    stm: Array
    tensor: Array


@dataclass(frozen=True)
class Waves:
    """Arcs F_k(x) = A_k x + W_k sin(V_k x), (n, 6, 6) each; linear where W is zero."""

    linear: Array
    amplitude: Array
    frequency: Array

    def propagate(self, k: int, state: Array) -> Array:
        return self.linear[k] @ state + self.amplitude[k] @ np.sin(self.frequency[k] @ state)

    def derivatives(self, start: Array) -> Arcs:
        w, v = self.amplitude, self.frequency
        phase = np.einsum("kij,kj->ki", v, start)
        return Arcs(
            state=np.array([self.propagate(k, x) for k, x in enumerate(start)]),
            stm=self.linear + np.einsum("kim,km,kmj->kij", w, np.cos(phase), v),
            tensor=-np.einsum("kim,km,kmj,kml->kijl", w, np.sin(phase), v, v),
        )

    def rollout(self, problem: FlybyProblem, burns: Array, defects: Array | float = 0.0) -> Iterate:
        """Node means mu_{k+1} = F_k(mu_k) + B dv_i - d_k with prescribed defects (n, 6)."""
        kicks = np.zeros((problem.n_nodes, 6))
        kicks[problem.burn_nodes, 3:] = burns
        defects = np.broadcast_to(defects, (problem.n_nodes - 1, 6))
        mean = [problem.initial_state + kicks[0]]
        for k in range(problem.n_nodes - 1):
            mean.append(self.propagate(k, mean[-1]) + kicks[k + 1] - defects[k])
        return Iterate(burns, np.array(mean))

    def linearise(self, problem: FlybyProblem, iterate: Iterate) -> Linearisation:
        return Linearisation(problem, iterate, self.derivatives(iterate.mean[:-1]))


@dataclass(frozen=True)
class Flyby:
    """A problem, its dynamics, and burns that reach its final state."""

    problem: FlybyProblem
    waves: Waves
    burns: Array

    def corrected(self, rng: np.random.Generator, cost: Cost = "dv99") -> Flyby:
        """The flyby with all burns after the first corrected, after measurements at random nodes."""
        burns = np.arange(1, self.problem.n_burns)
        lead = int(rng.integers(0, 1 + self.problem.burn_nodes[1]))
        feedback = Feedback(
            burns=burns,
            cut_offs=self.problem.burn_nodes[burns] - lead,
            measurement=0.02 * rng.normal(size=(len(burns), 6, 6)),
            cost=cost,
            probability=0.8,
        )
        return replace(self, problem=replace(self.problem, feedback=feedback))

    def flown(self, burns: Array, gains: Array | None = None) -> Linearisation:
        """Linearised about burns and gains, and where they lead."""
        iterate = self.waves.rollout(self.problem, burns)
        iterate = iterate if gains is None else replace(iterate, gains=gains)
        return self.waves.linearise(self.problem, iterate)

    def at(self, controls: Array) -> Linearisation:
        """The same, of both in one vector."""
        problem = self.problem
        return self.flown(controls[problem.burn_controls], controls[problem.gain_controls])

    def perturbed(self, rng: np.random.Generator, size: float, defect: float) -> Linearisation:
        """Linearised at burns and defects that are random, of about the given sizes."""
        burns = self.burns + size * rng.normal(size=self.burns.shape)
        defects = defect * rng.normal(size=(self.problem.n_nodes - 1, 6))
        return self.waves.linearise(self.problem, self.waves.rollout(self.problem, burns, defects))


def random_flyby(
    rng: np.random.Generator,
    *,
    nodes: int = 9,
    burns: int = 3,
    curvature: float = 0.1,
    coast: int = 0,
) -> Flyby:
    """Drifts of about one unit of length with random forces; no constraints.

    Args:
        rng: randomness.
        nodes: of the grid.
        burns: at the first, the last, and random nodes between.
        curvature: size of the arcs' nonlinear part; 0 makes them linear.
        coast: node of the first burn, before which a flight that is under way coasts.
    """
    n = nodes - 1
    drift = np.eye(6) + np.eye(6, k=3) / n
    waves = Waves(
        drift + 0.2 * rng.normal(size=(n, 6, 6)) / n,
        curvature * rng.normal(size=(n, 6, 6)),
        0.5 * rng.normal(size=(n, 6, 6)),
    )
    between = coast + 1 + rng.choice(nodes - 2 - coast, burns - 2, replace=False)
    problem = FlybyProblem(
        n_nodes=nodes,
        burn_nodes=np.array([coast, *sorted(between), n]),
        initial_state=rng.normal(size=6),
        final_state=np.zeros(6),
        initial_factor=0.02 * rng.normal(size=(6, int(rng.integers(1, 7)))),
        execution_errors=ComponentwiseErrors(float(rng.uniform(0.01, 0.1))),
        dv_max=3.0,
        sun=random_unit(rng, burns),
        dv_cone=float(rng.uniform(0.1, 0.5)),
        constraints=(),
    )
    kicks = 0.5 * rng.normal(size=(burns, 3))
    final = waves.rollout(problem, kicks).mean[-1]
    return Flyby(replace(problem, final_state=final), waves, kicks)


def constrain(
    rng: np.random.Generator, flyby: Flyby, keeps: Sequence[str] = ("in", "out")
) -> Flyby:
    """The flyby with balls and cones at some nodes, near its reference trajectory."""
    problem = flyby.problem
    track = flyby.waves.rollout(problem, flyby.burns).mean[:, :3]
    constraints = []
    for keep in keeps:
        for shape in ("ball", "cone"):
            chosen = np.sort(rng.choice(problem.n_nodes, 3, replace=False))
            away = random_unit(rng, 3)
            if shape == "ball":
                distance = 0.5 if keep == "in" else 1.0
                region: Ball | Cone = Ball(track[chosen] - distance * away, 0.8)
            else:
                side = np.cross(away, random_unit(rng, 3))
                side /= np.linalg.norm(side, axis=1, keepdims=True)
                offset = 0.2 if keep == "in" else 1.0
                apex = track[chosen] - away - offset * side
                region = Cone(apex, away, 0.6)
            constraints.append(StateConstraint(f"{shape}_{keep}", chosen, region, keep, 0.8))
    return replace(flyby, problem=replace(problem, constraints=tuple(constraints)))


def near_from(patch, room: float) -> None:
    """Let the rows of P3 and P2 take part in condensed programs from this room on."""
    for rows in (ChanceRows, DeterministicRows):
        patch.setattr(rows, "near", room)
