"""Plans satisfy the first-order conditions of the problem they claim to solve.

Mean and covariance are flown here once more, by a Runge-Kutta scheme whose STM comes from a complex
step of the acceleration, and differentiated by finite differences: nothing of the linearisation, of
the lifting or of the conic solver is used.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any
from unittest import mock

import cvxpy as cp
import numpy as np
import pytest
from hypothesis import HealthCheck, Phase, assume, given, settings

from formulations.arrays import Array
from formulations.linearisation.dynamics import Dynamics
from formulations.problem.facets import Facets
from formulations.problem.flyby import Iterate
from formulations.program.subproblem import PenaltyParameters, Subproblem
from scp_recon.errors import InputError
from scp_recon.mission.mission import Mission
from scp_recon.physics.forces import ForceModel, acceleration
from scp_recon.planning import initial_guess
from scp_recon.planning.planner import Plan, Stage, plan
from scp_recon.scenario.load import load_scenario
from scp_recon.scp.algorithms import ALGORITHMS, PTR, SCvx
from scp_recon.scp.loop import Algorithm, Record, State, Timing
from scp_recon.scp.status import Status
from tests.helpers import share_of_examples, usually
from tests.scenarios import planned, scenarios

expensive = settings(
    max_examples=share_of_examples(20, usual=1),
    phases=[Phase.explicit, Phase.reuse, Phase.generate],
    suppress_health_check=[HealthCheck.too_slow, HealthCheck.filter_too_much],
)
"""A plan takes a second; to look for a simpler one takes many."""

STEP, ACTIVE, VANISHING = 1e-5, 1e-5, 1e-5
"""Of the finite differences; margin of an active constraint; size of a burn that is none."""


def rates(y: tuple[Array, Array, Array], forces: ForceModel) -> tuple[Array, Array, Array]:
    """Of positions and velocities (n, 3) and STMs (n, 6, 6)."""
    r, v, stm = y
    step = 1e-20
    moved = r[:, None, :] + 1j * step * np.eye(3)
    pull = np.stack(acceleration(moved[..., 0], moved[..., 1], moved[..., 2], forces), axis=-1)
    gradient = pull.imag.swapaxes(1, 2) / step
    return v, pull[:, 0].real, np.concatenate([stm[:, 3:], gradient @ stm[:, :3]], axis=1)


def arc(state: Array, duration: float, forces: ForceModel, substeps: int) -> tuple[Array, Array]:
    """End states (n, 6) and STMs (n, 6, 6) of the classical Runge-Kutta scheme."""
    n, h = len(state), duration / substeps
    y = state[:, :3], state[:, 3:], np.broadcast_to(np.eye(6), (n, 6, 6))
    for _ in range(substeps):
        k = [rates(y, forces)]
        for share in (0.5, 0.5, 1.0):
            shifted = [a + share * h * b for a, b in zip(y, k[-1], strict=True)]
            k.append(rates((shifted[0], shifted[1], shifted[2]), forces))
        r, v, stm = (
            a + h / 6.0 * (k1 + 2.0 * k2 + 2.0 * k3 + k4)
            for a, k1, k2, k3, k4 in zip(y, *k, strict=True)
        )
        y = r, v, stm
    return np.concatenate([y[0], y[1]], axis=1), y[2]


def fly(mission: Mission, burns: Array) -> tuple[Array, Array]:
    """Means (nodes, n, 6) and covariances (nodes, n, 6, 6) of n plans, burns (n, m, 3)."""
    problem, flow, n = mission.problem, mission.flow, len(burns)
    mean = np.broadcast_to(problem.initial_state, (n, 6))
    covariance = np.broadcast_to(problem.initial_factor @ problem.initial_factor.T, (n, 6, 6))
    means, covariances = [], []
    for k in range(problem.n_nodes):
        if k > 0:
            duration = float(flow.durations[k - 1])
            mean, stm = arc(mean, duration, flow.forces, flow.substeps)
            covariance = stm @ covariance @ stm.swapaxes(1, 2)
        for burn in burns.swapaxes(0, 1)[problem.burn_nodes == k]:
            mean = mean + np.pad(burn, ((0, 0), (3, 0)))
            error = np.pad(mission.scenario.uncertainty.execution_error * burn, ((0, 0), (3, 0)))
            covariance = covariance + error[:, :, None] ** 2 * np.eye(6)
        means.append(mean)
        covariances.append(covariance)
    return np.array(means), np.array(covariances)


@dataclass(frozen=True)
class Values:
    """Of n plans: cost (n,), inequalities >= 0 (n, j), equalities = 0 (n, 6)."""

    cost: Array
    inequalities: Array
    equalities: Array


def evaluate(mission: Mission, facets: Facets, burns: Array) -> Values:
    """P2 with its facets fixed as a function of the burns alone, from its definition."""
    problem = mission.problem
    mean, covariance = fly(mission, burns)
    a, at = facets.normal, facets.node
    variance = np.einsum("mi,mnij,mj->nm", a, covariance[at][..., :3, :3], a)
    distance = facets.offset - np.einsum("mi,mni->nm", a, mean[at][..., :3])
    size = np.linalg.norm(burns, axis=2)
    along = np.abs(np.einsum("nbi,bi->nb", burns, problem.sun))
    across = np.linalg.norm(np.cross(burns, problem.sun), axis=2)
    return Values(
        size.sum(axis=1),
        np.concatenate(
            [
                distance - facets.quantile * np.sqrt(np.maximum(variance, 0.0)),
                problem.dv_max - size,
                np.cos(problem.dv_cone) * across - np.sin(problem.dv_cone) * along,
            ],
            axis=1,
        ),
        mean[-1] - problem.final_state,
    )


@dataclass(frozen=True)
class Conditions:
    """What the first-order conditions ask for at a plan.

    Attributes:
        infeasibility: largest violation of an inequality or an equality.
        residual: of stationarity, relative to the gradient of the cost.
        complementarity: largest product of a multiplier and its margin.
        largest: multiplier, of an inequality and of an equality.
    """

    infeasibility: float
    residual: float
    complementarity: float
    largest: tuple[float, float]


def conditions(mission: Mission, stage: Stage) -> Conditions:
    """Of P2 with the facets of a stage."""
    facets, burns = stage.facets, stage.result.lin.iterate.burns
    assert facets is not None
    return conditions_of(mission, burns, lambda points: evaluate(mission, facets, points))


def conditions_of(mission: Mission, burns: Array, values: Callable[[Array], Values]) -> Conditions:
    """Find multipliers >= 0 of the nearly active constraints by least squares, and see how good.

    Where a burn vanishes its size has no gradient: any vector of the unit ball is a subgradient, and
    the cone that burns stay out of, whose apex is there, is left aside.
    """
    z, m = burns.ravel(), mission.problem.n_burns
    steps = STEP * np.eye(len(z))
    points = np.vstack([z, z + steps, z - steps]).reshape(-1, m, 3)
    v = values(points)

    def gradient(values: Array) -> Array:
        forward, backward = np.split(values[1:], 2)
        return (forward - backward) / (2.0 * STEP)

    vanishing = np.linalg.norm(burns, axis=1) < VANISHING
    margin = v.inequalities[0]
    active = margin < ACTIVE
    active[len(active) - m :] &= ~vanishing
    cost = np.where(np.repeat(vanishing, 3), 0.0, gradient(v.cost))
    pull, miss = gradient(v.inequalities)[:, active], gradient(v.equalities)
    multiplier = cp.Variable(pull.shape[1], nonneg=True)
    force, subgradient = cp.Variable(6), cp.Variable((m, 3))
    free = cp.reshape(subgradient, (3 * m,), order="C")
    off = cost + free - pull @ multiplier - miss @ force
    ball = cp.norm(subgradient, axis=1) <= vanishing.astype(float)
    cp.Problem(cp.Minimize(cp.norm(off)), [ball]).solve(solver="CLARABEL")
    # What counts is the certificate, by arithmetic, and not what the solver says about it.
    found = np.maximum(multiplier.value, 0.0)
    sub = subgradient.value / np.maximum(
        np.linalg.norm(subgradient.value, axis=1, keepdims=True), 1
    )
    residual = cost + (vanishing[:, None] * sub).ravel() - pull @ found - miss @ force.value
    return Conditions(
        infeasibility=max(-float(margin.min()), float(np.abs(v.equalities[0]).max())),
        residual=float(np.linalg.norm(residual) / np.sqrt(m)),
        complementarity=float(np.abs(found * margin[active]).max(initial=0.0)),
        largest=(float(found.max(initial=0.0)), float(np.abs(force.value).max())),
    )


def converged(overrides: tuple[str, ...]) -> tuple[Mission, Plan]:
    """A random plan that converged on P2; the others are not looked at."""
    try:
        mission, found = planned(overrides)
    except InputError:
        assume(False)
    assume(found.final.result.status is Status.CONVERGED and found.final.facets is not None)
    return mission, found


@expensive
@given(scenarios())
def test_converged_plan_satisfies_kkt_with_facets_fixed(overrides):
    mission, found = converged(overrides)
    at = conditions(mission, found.final)
    assert at.infeasibility < 2.0 * SCvx.feasible
    assert at.residual < 1e-3
    assert at.complementarity < 1e-6
    # The penalty is exact where no multiplier is above its heaviest weight.
    assert max(at.largest) < SCvx.weight_max


@pytest.mark.parametrize(
    ("formulation", "least", "most"), [("condensed", 0.0, 1e-4), ("frozen-stm", 3e-3, np.inf)]
)
def test_default_plan_satisfies_kkt_frozen_stms_fail(formulation, least, most):
    """Frozen STMs converge to a feasible point of P2 that is none of its solutions."""
    mission = Mission.from_scenario(load_scenario())
    found = plan(mission, initial_guess.cold(mission), formulation=formulation)
    assert found.final.result.status is Status.CONVERGED
    at = conditions(mission, found.final)
    assert at.infeasibility < SCvx.feasible
    assert least <= at.residual < most
    if formulation == "condensed":
        assert at.complementarity < 1e-6


@dataclass
class Watched:
    """An algorithm, and the states that its steps led from and to."""

    inner: Algorithm
    steps: list[tuple[Subproblem, State, State]]

    def __getattr__(self, name: str) -> Any:
        return getattr(self.inner, name)

    def resolving(self, resolution: float) -> Watched:
        assert resolution == 0.0
        return self

    def step(
        self, subproblem: Subproblem, dynamics: Dynamics, state: State, k: int, timing: Timing
    ) -> tuple[State, Record]:
        new, record = self.inner.step(subproblem, dynamics, state, k, timing)
        assert record.accepted == (new.lin is not state.lin)
        self.steps.append((subproblem, state, new))
        return new, record


def merit_of(
    mission: Mission, subproblem: Subproblem, state: State, charge: PenaltyParameters
) -> float:
    """Of the burns alone, flown here once more and linearised anew."""
    problem, dynamics = mission.problem, mission.dynamics
    burns = state.lin.iterate.burns
    mean, _ = fly(mission, burns[None])
    lin = dynamics.linearise(problem, Iterate(burns, mean[:, 0]))
    return subproblem.merit(lin, charge)


@pytest.mark.slow
@pytest.mark.parametrize("algorithm", usually(["scvx-star", "ptr", "scvx"], 1))
@expensive
@given(scenarios())
def test_accepted_steps_never_raise_the_merit(algorithm, overrides):
    """Under the charge that the step was judged by, which may change from one step to the next.

    PTR takes a step that is lost in the merit's rounding.
    """
    slack = 1e-8 + (PTR.ROUNDING if algorithm == "ptr" else 0.0)
    try:
        mission = Mission.from_scenario(load_scenario(None, overrides))
    except InputError:
        assume(False)
    watched = Watched(ALGORITHMS[algorithm](), [])
    with mock.patch.dict(ALGORITHMS, {algorithm: lambda: watched}):
        plan(mission, initial_guess.cold(mission), algorithm=algorithm)
    taken = [
        (p, a, b)
        for p, a, b in watched.steps
        if b.lin is not a.lin and a.lin.is_dynamically_feasible
    ]
    assert taken
    for subproblem, before, after in taken:
        # Multipliers are updated after a step, a weight before it.
        charge = before.charge if before.charge.multipliers is not None else after.charge
        old, new = (merit_of(mission, subproblem, state, charge) for state in (before, after))
        assert new <= old + slack * max(1.0, abs(old))
