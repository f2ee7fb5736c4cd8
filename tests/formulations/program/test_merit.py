"""Cost and violations of an iterate by their definitions; the primer and multipliers by flights."""

from dataclasses import replace
from typing import get_args

import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st

from formulations.arrays import Array
from formulations.linearisation.linearisation import Linearisation, final_state_map
from formulations.problem.controls import Cost
from formulations.problem.flyby import FlybyProblem
from formulations.program.multipliers import adjoint, multipliers, slope_left
from formulations.program.subproblem import MeritFunction, PenaltyParameters
from formulations.registry import make_subproblem
from formulations.rows.cones import Rows
from formulations.rows.corrected_burns import CorrectedBurns
from formulations.rows.uniform import DeterministicRows
from tests.helpers import constrain, generators, random_flyby, share_of_examples

from .support import every_row, slope_of

some = settings(max_examples=10)


def mixed(rng: np.random.Generator) -> Linearisation:
    """An iterate with defects that keeps some constraints and breaks others, and some limits."""
    flyby = constrain(rng, random_flyby(rng, nodes=8, burns=4))
    sizes = np.linalg.norm(flyby.burns, axis=1)
    sunward = flyby.burns / sizes[:, None] * rng.choice([-1.0, 1.0], (4, 1)) + rng.normal(
        scale=0.3, size=(4, 3)
    )
    problem = replace(
        flyby.problem,
        dv_max=float(np.median(sizes)),
        sun=sunward / np.linalg.norm(sunward, axis=1, keepdims=True),
    )
    return replace(flyby, problem=problem).perturbed(rng, 0.1, 0.05)


def signed(lin: Linearisation) -> dict[str, Array]:
    """How far the iterate is on the wrong side, by name and one number at a time."""
    problem, burns = lin.problem, lin.iterate.burns
    sizes = [float(np.sqrt(burn @ burn)) for burn in burns]
    angles = [
        np.arccos(sense * burn @ sun / size)
        for sense in (1.0, -1.0)
        for burn, sun, size in zip(burns, problem.sun, sizes, strict=True)
    ]
    depth = [
        size * np.sin(problem.dv_cone - angle)
        for angle, size in zip(angles, sizes * 2, strict=True)
    ]
    found = {"dv_max": np.array(sizes) - problem.dv_max, "dv_battery": np.array(depth)}
    for c in problem.constraints:
        inside = c.region.inside(lin.iterate.mean[c.nodes, :3])
        found[c.name] = -inside if c.keep == "in" else inside
    return found


@some
@given(generators)
def test_violations_are_positive_parts_excess_is_signed(rng):
    lin = mixed(rng)
    problem, amounts = lin.problem, signed(lin)
    evaluation = MeritFunction(problem, DeterministicRows(problem))
    violations, margins = evaluation.violations(lin), evaluation.margins(lin)
    assert list(violations) == ["dynamics", *amounts]
    assert violations["dynamics"] == pytest.approx(np.abs(lin.defects).ravel())
    for name, amount in amounts.items():
        assert violations[name] == pytest.approx(np.maximum(amount, 0.0), abs=1e-12)
    expected = np.concatenate([lin.defects[-1], *amounts.values()])
    assert evaluation.excess(lin) == pytest.approx(expected, abs=1e-12)
    assert list(margins) == list(amounts)
    amounts["dv_battery"] = np.maximum(*np.split(amounts["dv_battery"], 2))
    nodes = dict.fromkeys(("dv_max", "dv_battery"), problem.burn_nodes)
    nodes |= {c.name: c.nodes for c in problem.constraints}
    for name, found in margins.items():
        assert found.margin == pytest.approx(-amounts[name], abs=1e-12)
        assert np.array_equal(found.nodes, nodes[name])
    assume(np.any(expected[6:] < 0.0) and np.any(expected[6:] > 0.0))


@some
@given(generators)
def test_merit_is_delta_v_plus_penalty(rng):
    lin = mixed(rng)
    evaluation, amounts = MeritFunction(lin.problem, DeterministicRows(lin.problem)), signed(lin)
    broken = np.concatenate([np.maximum(a, 0.0) for a in amounts.values()])
    cost = np.linalg.norm(lin.iterate.burns, axis=1).sum()
    exact = cost + 7.0 * (10.0 * np.abs(lin.defects).sum() + broken.sum())
    # Twice each, in turn: nothing of one iterate, or of one charge, is left for the next.
    other = mixed(rng)
    for _ in range(2):
        assert evaluation(lin, 7.0) == pytest.approx(exact)
        assert evaluation(lin, PenaltyParameters(7.0)) == pytest.approx(exact)
        # The proximal charge is the step's, not the iterate's.
        assert evaluation(lin, PenaltyParameters(7.0, prox=3.0)) == pytest.approx(exact)
        multipliers = rng.normal(size=6 + len(broken))
        charged = np.concatenate([lin.defects[-1], broken])
        augmented = cost + multipliers @ charged + 3.5 * sum(charged**2)
        charge = PenaltyParameters(7.0, multipliers=multipliers)
        assert evaluation(lin, charge) == pytest.approx(augmented)
        least = PenaltyParameters(1.0, least=True)
        assert evaluation(lin, least) == pytest.approx((exact - cost) / 7.0)
        bounded = PenaltyParameters(7.0, budget=0.4, allowed=np.inf)
        over = max((exact - cost) / 7.0 - 0.4, 0.0)
        assert evaluation(lin, bounded) == pytest.approx(cost + 7.0 * over)
        below = replace(bounded, allowed=0.99 * evaluation.worst_violation(lin))
        assert evaluation(lin, below) == np.inf
        alone = MeritFunction(lin.problem, DeterministicRows(lin.problem))(other, 7.0)
        assert evaluation(other, 7.0) == pytest.approx(alone) != pytest.approx(exact)


def strange_flight(rng: np.random.Generator) -> tuple[FlybyProblem, Linearisation]:
    """A problem, and a flight of one with other ends, another covariance and other limits."""
    flyby = constrain(rng, random_flyby(rng, nodes=8, burns=4))
    size = float(np.median(np.linalg.norm(flyby.burns, axis=1)))
    problem = replace(flyby.problem, dv_max=0.8 * size)
    strange = replace(
        problem,
        initial_state=problem.initial_state + 0.1 * rng.normal(size=6),
        final_state=problem.final_state + 0.1 * rng.normal(size=6),
        initial_factor=2.0 * problem.initial_factor,
        dv_max=50.0 * size,
        sun=problem.sun[::-1],
        constraints=(),
    )
    burns = flyby.burns + 0.1 * rng.normal(size=flyby.burns.shape)
    return problem, replace(flyby, problem=strange).flown(burns)


@some
@given(generators)
def test_other_flight_has_own_ends_same_limits(rng):
    problem, flight = strange_flight(rng)
    allowed = replace(
        flight.problem, dv_max=problem.dv_max, sun=problem.sun, constraints=problem.constraints
    )
    same = replace(flight, problem=allowed)  # as if it had been told everything
    rows = every_row(same, "P2")
    merit = MeritFunction(problem, rows)
    found, expected = merit.violations(flight), MeritFunction(allowed, rows).violations(same)
    assert list(found) == list(expected)
    for name, amounts in found.items():
        assert np.array_equal(amounts, expected[name])
    sizes = np.linalg.norm(flight.iterate.burns, axis=1)
    assert found["dv_max"] == pytest.approx(np.maximum(sizes - problem.dv_max, 0.0))
    miss = flight.iterate.mean[-1] - flight.problem.final_state
    assert merit.excess(flight)[:6] == pytest.approx(miss)
    facets = every_row(same, "P2").margins(flight)
    own = replace(flight, problem=replace(flight.problem, initial_factor=problem.initial_factor))
    narrow = every_row(same, "P2").margins(own)
    assert any(np.any(facets[name].margin < narrow[name].margin) for name in facets)


@some
@given(generators, st.integers(0, 4))
def test_optional_miss_is_cost_not_violation(rng, coast):
    flyby = random_flyby(rng, coast=coast)
    problem = replace(flyby.problem, miss_weight=7.0)
    lin = replace(flyby, problem=problem).perturbed(rng, 0.1, 0.0)
    merit = MeritFunction(problem, DeterministicRows(problem))
    miss = np.abs(lin.iterate.mean[-1] - problem.final_state).sum()
    violations = merit.violations(lin)
    assert violations["dynamics"].max() < 1e-9
    limits = sum(amount.sum() for amount in violations.values())
    assert merit(lin, 10.0) == pytest.approx(
        lin.iterate.total_dv + 7.0 * miss + 10.0 * limits, abs=1e-6
    )


def prices_of(rng: np.random.Generator, rows: Rows, burns: int) -> Array:
    """Random prices of the miss and of the rows, none of the burns' own limits."""
    of_rows = np.abs(rng.normal(size=rows.count))
    return np.concatenate([rng.normal(size=6), np.zeros(3 * burns), of_rows])


def by_burns(lin: Linearisation, rows: Rows, prices: Array) -> Array:
    """Derivative of the priced miss and rows by all burns: of the affine model, forwards."""
    burns, slope = lin.problem.burn_controls.ravel(), np.zeros(len(lin.controls))
    slope[burns] = final_state_map(lin)[1].T @ prices[:6]
    return (slope - slope_of(lin, rows, prices[6 + len(burns) :]))[burns]


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
    gains = 0.1 * rng.normal(size=len(lin.problem.gain_controls))
    return replace(lin, iterate=replace(lin.iterate, gains=gains))


@given(generators, st.sampled_from(["P3", "P2", "P2 and spread", "node", "flight"]), st.booleans())
@settings(max_examples=share_of_examples(1))
def test_the_adjoint_is_the_affine_model_read_backwards(rng, name, corrected):
    """For prices of rows that feel the states, and not of limits on the burns alone."""
    exact = name in ("node", "flight")
    flyby = random_flyby(rng, nodes=8, burns=3 if exact else 4)
    flyby = constrain(rng, flyby, ("in",) if exact else ("in", "out"))
    if name == "P2 and spread":
        flyby = replace(flyby, problem=replace(flyby.problem, final_spread=(0.3, 0.2)))
    flyby = flyby.corrected(rng) if corrected else flyby
    lin = flyby.perturbed(rng, 0.02 if exact else 0.1, 0.0)
    lin = with_gains(rng, lin) if corrected else lin
    rows = every_row(lin, name.removesuffix(" and spread"))
    prices = prices_of(rng, rows, lin.problem.n_burns)
    if rows.with_factor:
        prices[len(prices) - CorrectedBurns(lin.problem, 0).count :] = 0.0
    expected = by_burns(lin, rows, prices)
    scale = (1e-7 if exact else 1e-9) * max(1.0, float(np.abs(expected).max()))
    np.testing.assert_allclose(backwards(lin, rows, prices), expected, atol=scale)


@pytest.mark.slow
@given(generators, st.booleans(), st.sampled_from([None, *get_args(Cost)]))
@settings(max_examples=share_of_examples(2, usual=4))
def test_multipliers_are_best_signed_fit_of_binding(rng, vanishing, corrected):
    """By differences of flown excesses, for the conditions of non-negative least squares."""
    flyby = constrain(rng, random_flyby(rng, nodes=8, burns=2 if corrected else 4))
    flyby = flyby.corrected(rng, corrected) if corrected else flyby
    burns = flyby.burns + 0.1 * rng.normal(size=flyby.burns.shape)
    problem = replace(flyby.problem, dv_max=float(np.median(np.linalg.norm(burns, axis=1))))
    flyby = replace(flyby, problem=problem)
    burns[1] *= not vanishing
    lin = with_gains(rng, flyby.flown(burns))
    rows = every_row(lin, "P2")
    merit, step = MeritFunction(problem, rows), 1e-6

    def cost_and_excess(z: Array) -> Array:
        flown = flyby.at(z)
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


@pytest.mark.slow
def test_remaining_slope_certifies_burns_and_gains():
    """From 0.94 at a start of random gains."""
    rng = np.random.default_rng(11)
    flyby = random_flyby(rng, nodes=5, burns=3, curvature=0.01)
    flyby = constrain(rng, flyby, ("in",)).corrected(rng, "expected")
    problem = flyby.problem
    quieter = replace(problem.feedback, measurement=0.3 * problem.feedback.measurement)
    problem = replace(problem, feedback=quieter)
    flown = replace(flyby, problem=problem).flown

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
