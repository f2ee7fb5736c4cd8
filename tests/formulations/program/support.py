"""Shared by the tests of the convex program: flybys, charges, and the same program said plainly."""

import warnings
from typing import NamedTuple, get_args

import cvxpy as cp
import numpy as np
import pytest
import scipy.sparse as sp

from formulations.arrays import Array
from formulations.linearisation.linearisation import Condensation, Linearisation, condense, gradient
from formulations.problem.facets import Polytopes, ball, choose_facets
from formulations.problem.regions import Ball
from formulations.program import solvers
from formulations.program.solvers import ConeProgram
from formulations.program.subproblem import MeritFunction, Penalty, PenaltyParameters, Step
from formulations.rows.cones import Cones, Rows
from formulations.rows.exact import NodeRows
from formulations.rows.exact_flight import FlightRows
from formulations.rows.uniform import ChanceRows, DeterministicRows
from tests.helpers import constrain, random_flyby

PENALTIES: tuple[Penalty, ...] = get_args(Penalty)
TIGHT = 1e-11
"""Of the conic solver, where two programs for the same problem are compared and not its accuracy."""


def linearised(rng: np.random.Generator, keeps: tuple[str, ...] = ("in", "out")) -> Linearisation:
    """A random flyby of four burns, none of them small, with constraints after each of them."""
    while True:
        flyby = constrain(rng, random_flyby(rng, nodes=8, burns=4), keeps)
        lin = flyby.perturbed(rng, 0.1, 0.05)
        if np.linalg.norm(lin.iterate.burns, axis=1).min() > 0.02 * lin.problem.dv_max:
            return lin


def small(seed: int = 3, *, defect: float = 0.05, **sizes: int) -> Linearisation:
    """One of few nodes, quick to solve in every form."""
    rng = np.random.default_rng(seed)
    return constrain(rng, random_flyby(rng, **{"nodes": 5, **sizes})).perturbed(rng, 0.1, defect)


def every_row(lin: Linearisation, name: str, facets: int = 8) -> Rows:
    """The constraints of P3, all facets of P2 placed at the iterate, or exact risk by its scope."""
    if name == "P3":
        return DeterministicRows(lin.problem)
    if name == "node":
        return NodeRows(lin.problem, 0.7)
    if name == "flight":
        return FlightRows(lin.problem, 0.7, 256, 0.0)
    polytopes = Polytopes(ball(facets), max(3, facets // 2))
    chosen = choose_facets(lin.problem, polytopes, lin.iterate.mean, lin.factor)
    return ChanceRows(lin.problem, chosen, np.ones(len(chosen.node), dtype=np.bool_))


def slack(cones: Cones, z: Array) -> Array:
    """What rows leave at some controls, y_0 - ||y_1..||."""
    y = cones.at(z)
    return np.asarray(y[:, 0] - np.linalg.norm(y[:, 1:], axis=1))


def slope_of(lin: Linearisation, rows: Rows, prices: Array) -> Array:
    """Gradient by all controls of the priced slacks of rows, of the affine model."""
    slope = np.zeros(len(lin.controls))
    for cones in rows.cones(lin, condense(lin, rows.nodes, factor=rows.with_factor)):
        p, y = cones.values.shape[2], cones.at(lin.controls)
        size = np.maximum(np.linalg.norm(y[:, 1:], axis=1), 1e-300)
        bent = np.einsum("nd,ndp->np", y[:, 1:] / size[:, None], cones.values[:, 1:])
        slope[:p] += prices[cones.rows] @ (cones.values[:, 0] - bent)
    return slope


def assert_transposed(lin: Linearisation, rng: np.random.Generator, by_mean: int = 6) -> None:
    """`gradient` is the transpose of `condense`, of random functions of means and factors."""
    slopes = rng.normal(size=(lin.problem.n_nodes, by_mean)), rng.normal(size=lin.factor.shape)
    s = condense(lin)
    expected = np.einsum("ki,kiz->z", slopes[0], s.mean_jacobian[:, :by_mean])
    expected += np.einsum("kic,kicz->z", slopes[1], s.factor_jacobian)
    found, scale = gradient(lin, *slopes), max(1.0, float(np.abs(expected).max()))
    np.testing.assert_allclose(found, expected, rtol=1e-7, atol=1e-8 * scale)


def charge_for(
    penalty: Penalty, rows: Rows, lin: Linearisation, weight: float = 10.0
) -> PenaltyParameters:
    if penalty == "augmented":
        count = 6 + 3 * lin.problem.n_burns + rows.count
        return PenaltyParameters(2.0 * weight, multipliers=np.linspace(0.0, 2.0, count))
    if penalty == "least":
        return PenaltyParameters(1.0, least=True)
    if penalty == "bounded":
        violated = MeritFunction(lin.problem, rows).violated(lin)
        return PenaltyParameters(weight, budget=0.9 * violated, allowed=np.inf)
    return PenaltyParameters(weight, prox=0.7 if penalty == "proximal" else 0.0)


def minimum(step: Step, lin: Linearisation, charge: PenaltyParameters) -> float:
    """The program's minimum: a step's merit with what a proximal penalty charges for it."""
    return step.merit + 0.5 * charge.prox * float(((step.burns - lin.iterate.burns) ** 2).sum())


def tighten(patch) -> None:
    """Have every solver that our tolerance reaches solve to `TIGHT`."""
    patch.setattr(solvers, "TOLERANCE", TIGHT)


def alone(patch, solver: str) -> None:
    """Leave a solver nobody to fall back on, so that what is answered it has answered itself."""
    for other in [name for name in solvers.SOLVERS if name != solver]:
        patch.delitem(solvers.SOLVERS, other)


def need(solver: str) -> None:
    """Skip where a solver that need not be installed is not."""
    if solver not in solvers.installed():
        pytest.skip(f"{solver} is not installed")


def tent(price: float = 1.0, size: float = 1.0) -> tuple[ConeProgram, Array, Array]:
    """Min price t with t >= ||(x - size, x + size)||, x <= 10 size and y = x; optimum and proof."""
    rows = [[0, 1, -1], [0, 1, 0], [-1, 0, 0], [0, -1, 0], [0, -1, 0]]
    matrix = sp.csc_array(np.array(rows, dtype=float))
    bound = size * np.array([0.0, 10.0, 0.0, -1.0, 1.0])
    program = ConeProgram(price * np.eye(3)[0], matrix, bound, 1, 1, (3,))
    half = np.sqrt(0.5)
    x, z = size * np.array([2.0 * half, 0.0, 0.0]), price * np.array([0.0, 0.0, 1.0, half, -half])
    return program, x, z


def disk(rng: np.random.Generator, equations: int) -> ConeProgram:
    """The lowest point of a disk within a box, on a plane if there is an equation; no number stays."""
    plane = rng.uniform(0.5, 1.0, (equations, 3))
    sides, radius = rng.uniform(0.8, 1.2, (2, 3)), rng.uniform(1.1, 1.2, 1)
    both = np.diag(sides[0]), -np.diag(sides[0])
    matrix = np.vstack([plane, *both, np.zeros((1, 3)), -np.eye(3)])
    known = plane @ rng.uniform(-0.2, 0.2, 3), sides[1], sides[1]
    bound = np.concatenate([*known, radius, np.zeros(3)])
    return ConeProgram(rng.normal(size=3), sp.csc_array(matrix), bound, equations, 6, (4,))


class Optimum(NamedTuple):
    """Least value, and the burns (m, 3) it is attained at."""

    value: float
    burns: Array


def solve_plainly(
    lin: Linearisation,
    rows: Rows,
    radius: float,
    penalty: Penalty,
    charge: PenaltyParameters,
    condensation: Condensation = condense,
) -> Optimum:
    """The convex subproblem from the sensitivities of mean and factor, without a reduction.

    Args:
        lin: the iterate.
        rows: all of which are in the program.
        radius: of the trust region.
        penalty: how violations and steps are charged.
        charge: how much.
        condensation: of mean and factor.
    """
    problem, m = lin.problem, lin.problem.n_burns
    z = cp.Variable((m, 3))
    stacked = cp.vec(z, order="C")
    end = condensation(lin, np.array([problem.n_nodes - 1]), factor=False)
    miss = end.mean_constant[0] + end.mean_jacobian[0] @ stacked - problem.final_state
    too_large = cp.norm(z, axis=1) - problem.dv_max
    sunward = cp.hstack([-cp.sum(cp.multiply(n, z), axis=1) for n in cone_planes(lin)])
    excess = [too_large, sunward, *_row_excess(lin, rows, condensation, stacked)]
    v = [cp.Variable(amount.shape[0], nonneg=True) for amount in excess]
    within = [amount <= buffer for amount, buffer in zip(excess, v, strict=True)]
    step = z - lin.iterate.burns
    cost = cp.sum(cp.norm(z, axis=1))
    if penalty == "augmented":
        assert charge.multipliers is not None
        charged = cp.hstack([miss, *v])
        cost += charge.multipliers @ charged + 0.5 * charge.weight * cp.sum_squares(charged)
    else:
        violated = 10.0 * cp.norm1(miss) + sum(cp.sum(buffer) for buffer in v)
        if penalty == "bounded":
            within.append(violated <= charge.budget)
        else:
            cost = charge.weight * violated + (0.0 if penalty == "least" else cost)
        if penalty == "proximal":
            cost += 0.5 * charge.prox * cp.sum_squares(step)
    program = cp.Problem(cp.Minimize(cost), [cp.abs(step) <= radius, *within])
    # Squares as cones, as a quadratic objective keeps Clarabel short of its tolerances. Where it is, it
    # calls an answer inaccurate that is better than a wider tolerance would have it.
    tolerances = dict.fromkeys(("tol_gap_abs", "tol_gap_rel", "tol_feas"), TIGHT)
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", "Solution may be inaccurate")
        value = program.solve(solver=cp.CLARABEL, use_quad_obj=False, **tolerances)
    assert program.status in (cp.OPTIMAL, cp.OPTIMAL_INACCURATE)
    return Optimum(float(value), np.asarray(z.value))


def cone_planes(lin: Linearisation) -> tuple[Array, Array]:
    """Normals of the planes that touch the battery's two cones nearest to each burn, (m, 3) each."""
    burns, sun, half = lin.iterate.burns, lin.problem.sun, lin.problem.dv_cone
    across = burns - np.sum(burns * sun, axis=1, keepdims=True) * sun
    across /= np.linalg.norm(across, axis=1, keepdims=True)
    return np.cos(half) * across - np.sin(half) * sun, np.cos(half) * across + np.sin(half) * sun


def _row_excess(
    lin: Linearisation, rows: Rows, condensation: Condensation, z: cp.Expression
) -> list[cp.Expression]:
    """How far the model is on the wrong side of every row, in their order."""
    s = condensation(lin, rows.nodes, factor=rows.with_factor)
    where = {int(node): k for k, node in enumerate(rows.nodes)}

    def mean(node: int) -> cp.Expression:
        k = where[node]
        return s.mean_constant[k, :3] + s.mean_jacobian[k, :3] @ z

    if isinstance(rows, ChanceRows):
        carried = rows.carried
        found = []
        for a, b, q, node in zip(
            carried.normal, carried.offset, carried.quantile, carried.node, strict=True
        ):
            k = where[int(node)]
            # S'a, (c,): each column of the factor along the facet's normal.
            constant = a @ s.factor_constant[k, :3]
            jacobian = np.einsum("i,icz->cz", a, s.factor_jacobian[k, :3])
            found.append(a @ mean(int(node)) + q * cp.norm(constant + jacobian @ z) - b)
        return [cp.hstack(found)] if found else []
    blocks = []
    for c in rows.problem.constraints:
        found = []
        for i, node in enumerate(c.nodes):
            at = lin.iterate.mean[node, :3]
            if isinstance(c.region, Ball):
                centre, reach = c.region.center[i], c.region.radius
                normal = (at - centre) / np.linalg.norm(at - centre)
                inward = cp.norm(mean(int(node)) - centre) - reach
                outward = reach - normal @ (mean(int(node)) - centre)
            else:
                axis, half = c.region.axis[i], c.region.half_angle
                apart = at - c.region.apex[i]
                across = np.eye(3) - np.outer(axis, axis)
                side = across @ apart / np.linalg.norm(across @ apart)
                d = mean(int(node)) - c.region.apex[i]
                inward = np.cos(half) * cp.norm(across @ d) - np.sin(half) * (axis @ d)
                outward = -(np.cos(half) * side - np.sin(half) * axis) @ d
            found.append(inward if c.keep == "in" else outward)
        blocks.append(cp.hstack(found))
    return blocks
