"""The primer: the adjoint against the affine model, and against flights with one more burn."""

from __future__ import annotations

from dataclasses import replace
from typing import get_args

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from formulations.arrays import Array
from formulations.linearisation.linearisation import (
    Linearisation,
    condense,
    final_state_map,
)
from formulations.problem.execution_errors import (
    ComponentwiseErrors,
    ExecutionErrors,
    GatesErrors,
)
from formulations.problem.feedback import Cost
from formulations.program.multipliers import adjoint, multipliers, primer, slope_left
from formulations.program.subproblem import MeritFunction
from formulations.registry import make_subproblem
from formulations.rows.cones import Rows
from formulations.rows.corrected_burns import CorrectedBurns
from formulations.rows.exact import NodeRows
from formulations.rows.exact_flight import FlightRows
from formulations.rows.uniform import ChanceRows
from tests.helpers import constrain, generators, random_flyby, share_of_examples

from .support import every_row

BIASED = GatesErrors(0.0, 0.02, 0.0, 0.03, 0.04)


def prices_of(rng: np.random.Generator, rows: Rows, burns: int) -> Array:
    """Random prices of the miss and of the rows, none of the burns' own limits."""
    of_rows = np.abs(rng.normal(size=rows.count))
    return np.concatenate([rng.normal(size=6), np.zeros(3 * burns), of_rows])


def by_burns(lin: Linearisation, rows: Rows, prices: Array) -> Array:
    """Derivative of the priced miss and rows by all burns: of the affine model, forwards."""
    z, burns = lin.controls, lin.problem.burn_controls.ravel()
    slope = np.zeros(len(z))
    slope[burns] = final_state_map(lin)[1].T @ prices[:6]
    of_rows = prices[6 + len(burns) :]
    for cones in rows.cones(lin, condense(lin, rows.nodes, factor=rows.with_factor)):
        p = cones.values.shape[2]
        y = cones.values @ z[:p] + cones.constants
        size = np.maximum(np.linalg.norm(y[:, 1:], axis=1), 1e-300)
        bent = np.einsum("nd,ndp->np", y[:, 1:] / size[:, None], cones.values[:, 1:])
        slope[:p] += of_rows[cones.rows] @ (bent - cones.values[:, 0])
    return slope[burns]


def backwards(lin: Linearisation, rows: Rows, prices: Array) -> Array:
    """The same by the adjoint, at the nodes of the burns, with what a burn's own errors add."""
    problem, nodes = lin.problem, lin.problem.burn_nodes
    by_mean, by_factor, by_error = adjoint(rows, lin, prices)
    found = by_mean[nodes, 3:]
    if rows.with_factor:
        errors = problem.execution_errors
        unit = errors.jacobian(lin.iterate.burns)
        for i, node in enumerate(nodes):
            felt = by_factor[node, 3:] + by_error[node, 3:]
            both = np.hstack([felt[:, problem.shared_columns], felt[:, problem.columns_of_burn(i)]])
            found[i] += np.einsum("ic,icj->j", both, unit[i])
    return found.ravel()


def with_gains(rng: np.random.Generator, lin: Linearisation) -> Linearisation:
    """Some corrections of an iterate."""
    gains = 0.1 * rng.normal(size=len(lin.problem.gain_controls))
    return replace(lin, iterate=replace(lin.iterate, gains=gains))


@given(generators, st.sampled_from(["P3", "P2", "P2 and spread", "node", "flight"]), st.booleans())
@settings(max_examples=share_of_examples(1))
def test_the_adjoint_is_the_affine_model_read_backwards(
    rng: np.random.Generator, name: str, corrected: bool
) -> None:
    """For prices of rows that feel the states, and not of limits on the burns alone."""
    exact = name in ("node", "flight")
    flyby = random_flyby(rng, nodes=8, burns=3 if exact else 4)
    flyby = constrain(rng, flyby, ("in",) if exact else ("in", "out"))
    if name == "P2 and spread":
        flyby = replace(flyby, problem=replace(flyby.problem, final_spread=(0.3, 0.2)))
    flyby = flyby.corrected(rng) if corrected else flyby
    lin = flyby.perturbed(rng, 0.02 if exact else 0.1, 0.0)
    lin = with_gains(rng, lin) if corrected else lin
    rows: Rows
    if name == "node":
        rows = NodeRows(lin.problem, 0.7)
    elif name == "flight":
        rows = FlightRows(lin.problem, 0.7, lines=64, resolution=0.0)
    else:
        rows = every_row(lin, name[:2])
    prices = prices_of(rng, rows, lin.problem.n_burns)
    if rows.with_factor:
        prices[len(prices) - CorrectedBurns(lin.problem, 0).count :] = 0.0
    expected = by_burns(lin, rows, prices)
    scale = (1e-7 if exact else 1e-9) * max(1.0, float(np.abs(expected).max()))
    np.testing.assert_allclose(backwards(lin, rows, prices), expected, atol=scale)


@given(generators, st.sampled_from([ComponentwiseErrors(0.05), BIASED]), st.booleans())
@settings(max_examples=share_of_examples(2))
def test_it_tells_what_a_small_burn_more_does_to_a_flight(
    rng: np.random.Generator, errors: ExecutionErrors, corrected: bool
) -> None:
    """By differences of nonlinear flights with one more burn and all errors of it."""
    flyby = constrain(rng, random_flyby(rng, nodes=9, burns=3))
    flyby = flyby.corrected(rng) if corrected else flyby
    problem = replace(flyby.problem, execution_errors=errors)
    burns = flyby.burns + 0.1 * rng.normal(size=flyby.burns.shape)
    lin = flyby.waves.linearise(problem, flyby.waves.rollout(problem, burns))
    lin = with_gains(rng, lin) if corrected else lin
    rows = every_row(lin, "P2")
    assert isinstance(rows, ChanceRows)
    prices = prices_of(rng, rows, problem.n_burns)
    at = int(rng.choice(np.setdiff1d(np.arange(problem.n_nodes), problem.burn_nodes)))
    place = int(np.searchsorted(problem.burn_nodes, at))
    wider = replace(
        problem,
        burn_nodes=np.insert(problem.burn_nodes, place, at),
        sun=np.insert(problem.sun, place, problem.sun[0], axis=0),
    )
    if problem.feedback is not None:
        later = problem.feedback.burns + (problem.feedback.burns >= place)
        wider = replace(wider, feedback=replace(problem.feedback, burns=later))
    same_rows = ChanceRows(wider, rows.facets, rows.included)
    u = rng.normal(size=3)

    def priced(size: float) -> float:
        more = np.insert(burns, place, size * u, axis=0)
        iterate = replace(flyby.waves.rollout(wider, more), gains=lin.iterate.gains)
        flown = flyby.waves.linearise(wider, iterate)
        margins = [part.margin for part in same_rows.margins(flown).values()]
        excess = np.concatenate([flown.defects[-1], *[-part for part in margins]])
        return float(excess @ np.r_[prices[:6], prices[6 + 3 * problem.n_burns :]])

    step = 1e-5
    expected = (priced(step) - priced(-step)) / (2.0 * step)
    found = -primer(rows, lin, prices)[at] @ u
    assert found == pytest.approx(expected, rel=1e-5, abs=1e-6)


@given(generators, st.booleans(), st.sampled_from([None, *get_args(Cost)]))
@settings(max_examples=share_of_examples(2, usual=4))
def test_multipliers_are_the_best_signed_ones_of_what_binds(
    rng: np.random.Generator, vanishing: bool, corrected: Cost | None
) -> None:
    """By differences of flown excesses, for the conditions of non-negative least squares."""
    flyby = constrain(rng, random_flyby(rng, nodes=8, burns=2 if corrected else 4))
    flyby = flyby.corrected(rng, corrected) if corrected else flyby
    burns = flyby.burns + 0.1 * rng.normal(size=flyby.burns.shape)
    problem = replace(flyby.problem, dv_max=float(np.median(np.linalg.norm(burns, axis=1))))
    burns[1] *= not vanishing
    lin = with_gains(rng, flyby.waves.linearise(problem, flyby.waves.rollout(problem, burns)))
    rows = every_row(lin, "P2")
    merit, step = MeritFunction(problem, rows), 1e-6

    def cost_and_excess(z: Array) -> Array:
        moved = flyby.waves.rollout(problem, z[problem.burn_controls])
        moved = replace(moved, gains=z[problem.gain_controls])
        flown = flyby.waves.linearise(problem, moved)
        return np.r_[merit.cost(flown), merit.excess(flown)]

    z, found = lin.controls, multipliers(problem, rows, lin)
    moves = step * np.eye(len(z))
    both = np.array([cost_and_excess(z + m) - cost_and_excess(z - m) for m in moves]).T
    slope, jacobian = both[0] / (2.0 * step), both[1:] / (2.0 * step)
    there = np.full(len(z), True)
    there[problem.burn_controls] = burns.any(axis=1)[:, None]
    left = np.where(there, slope + jacobian.T @ found, 0.0)
    assert slope_left(problem, rows, lin, found) == pytest.approx(np.abs(left).max(), abs=1e-5)
    binding, against = cost_and_excess(z)[1:] > -1e-5, jacobian @ left
    binding[:6] = True
    scale = 1e-4 * (1.0 + np.abs(jacobian).max() * (1.0 + np.abs(found).max()))
    assert not found[~binding].any()
    assert found[6:].min() >= -1e-12
    assert np.abs(against[np.abs(found) > 1e-6]).max() < scale
    assert np.all(against[6:][binding[6:]] > -scale)


def test_where_steps_end_that_lower_the_merit_the_slope_left_certifies_burns_and_gains() -> None:
    """From 0.94 at a start of random gains."""
    rng = np.random.default_rng(11)
    flyby = random_flyby(rng, nodes=5, burns=3, curvature=0.01)
    flyby = constrain(rng, flyby, ("in",)).corrected(rng, "expected")
    problem = flyby.problem
    assert problem.feedback is not None
    quieter = replace(problem.feedback, measurement=0.3 * problem.feedback.measurement)
    problem = replace(problem, feedback=quieter)

    def flown(burns: Array, gains: Array) -> Linearisation:
        iterate = replace(flyby.waves.rollout(problem, burns), gains=gains)
        return flyby.waves.linearise(problem, iterate)

    def left(lin: Linearisation) -> float:
        return slope_left(problem, rows, lin, multipliers(problem, rows, lin))

    lin = flown(flyby.burns, 0.1 * rng.normal(size=quieter.size))
    rows = every_row(lin, "P2", 6)
    subproblem, weight, radius = make_subproblem(problem, rows), 30.0, 0.3
    assert left(lin) > 0.5
    for _ in range(16):
        subproblem.update(lin)
        step = subproblem.solve(radius, weight)
        before, after = subproblem.merit(lin, weight), flown(step.burns, step.gains)
        gained = before - subproblem.merit(after, weight)
        if gained > 0.1 * (before - step.merit):
            lin = after
        radius = radius / 3.0 if gained < 0.1 * (before - step.merit) else min(2.0 * radius, 1.0)
    assert subproblem.merit.worst_violation(lin) < 1e-9
    assert np.abs(lin.iterate.gains).max() > 0.01
    assert left(lin) < 2e-4
