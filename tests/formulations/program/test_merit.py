"""Cost and violations of an iterate, by their definitions."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st

from formulations.arrays import Array
from formulations.linearisation.linearisation import Linearisation
from formulations.problem.flyby import FlybyProblem
from formulations.program.subproblem import (
    MeritFunction,
    PenaltyParameters,
)
from formulations.registry import make_subproblem
from formulations.rows.uniform import DeterministicRows
from tests.formulations.program.support import every_row
from tests.helpers import constrain, generators, random_flyby

some = settings(max_examples=10)


def linearised(rng: np.random.Generator) -> Linearisation:
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
    found = {
        "dv_max": np.array(sizes) - problem.dv_max,
        "dv_battery": np.array(depth),
    }
    for c in problem.constraints:
        inside = c.region.inside(lin.iterate.mean[c.nodes, :3])
        found[c.name] = -inside if c.keep == "in" else inside
    return found


@some
@given(generators)
def test_violations_are_positive_parts_and_excess_has_their_signs(rng: np.random.Generator) -> None:
    lin = linearised(rng)
    evaluation, amounts = MeritFunction(lin.problem, DeterministicRows(lin.problem)), signed(lin)
    violations = evaluation.violations(lin)
    assert list(violations) == ["dynamics", *amounts]
    assert violations["dynamics"] == pytest.approx(np.abs(lin.defects).ravel())
    for name, amount in amounts.items():
        assert violations[name] == pytest.approx(np.maximum(amount, 0.0), abs=1e-12)
    expected = np.concatenate([lin.defects[-1], *amounts.values()])
    assert evaluation.excess(lin) == pytest.approx(expected, abs=1e-12)
    assume(np.any(expected[6:] < 0.0) and np.any(expected[6:] > 0.0))


@some
@given(generators)
def test_margins_of_burns_belong_to_their_nodes(rng: np.random.Generator) -> None:
    lin = linearised(rng)
    problem, amounts = lin.problem, signed(lin)
    margins = MeritFunction(problem, DeterministicRows(problem)).margins(lin)
    assert list(margins) == list(amounts)
    toward, away = np.split(amounts["dv_battery"], 2)
    amounts["dv_battery"] = np.maximum(toward, away)
    nodes = dict.fromkeys(("dv_max", "dv_battery"), problem.burn_nodes)
    nodes |= {c.name: c.nodes for c in problem.constraints}
    for name, found in margins.items():
        assert found.margin == pytest.approx(-amounts[name], abs=1e-12)
        assert np.array_equal(found.nodes, nodes[name])


@some
@given(generators)
def test_the_merit_is_delta_v_plus_what_the_penalty_charges(rng: np.random.Generator) -> None:
    lin = linearised(rng)
    evaluation, amounts = MeritFunction(lin.problem, DeterministicRows(lin.problem)), signed(lin)
    broken = np.concatenate([np.maximum(a, 0.0) for a in amounts.values()])
    cost = np.linalg.norm(lin.iterate.burns, axis=1).sum()
    exact = cost + 7.0 * (10.0 * np.abs(lin.defects).sum() + broken.sum())
    # Twice each, in turn: nothing of one iterate, or of one charge, is left for the next.
    other = linearised(rng)
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
    return problem, flyby.waves.linearise(strange, flyby.waves.rollout(strange, burns))


@some
@given(generators)
def test_a_flight_from_elsewhere_is_judged_by_its_own_ends_and_the_merits_limits(
    rng: np.random.Generator,
) -> None:
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


@pytest.mark.parametrize("formulation", ["condensed", "lifted"])
def test_a_subproblem_is_of_the_same_mind(formulation: str) -> None:
    problem, flight = strange_flight(np.random.default_rng(3))
    allowed = replace(
        flight.problem, dv_max=problem.dv_max, sun=problem.sun, constraints=problem.constraints
    )
    same = replace(flight, problem=allowed)
    rows = every_row(same, "P2")
    steps = []
    for at, lin in ((problem, flight), (allowed, same)):
        subproblem = make_subproblem(at, rows, formulation)
        subproblem.update(lin)
        steps.append(subproblem.solve(1.0, 10.0))
    assert steps[0].merit == pytest.approx(steps[1].merit)
    assert steps[0].burns == pytest.approx(steps[1].burns, abs=1e-6)
    assert np.linalg.norm(steps[0].burns, axis=1).max() < 2.0 * problem.dv_max


@some
@given(generators, st.integers(0, 4))
def test_a_miss_that_need_not_be_met_is_a_cost_and_no_violation(
    rng: np.random.Generator, coast: int
) -> None:
    flyby = random_flyby(rng, coast=coast)
    problem = replace(flyby.problem, miss_weight=7.0)
    burns = flyby.burns + 0.1 * rng.normal(size=flyby.burns.shape)
    lin = flyby.waves.linearise(problem, flyby.waves.rollout(problem, burns))
    merit = MeritFunction(problem, DeterministicRows(problem))
    miss = np.abs(lin.iterate.mean[-1] - problem.final_state).sum()
    violations = merit.violations(lin)
    assert violations["dynamics"].max() < 1e-9
    limits = sum(amount.sum() for amount in violations.values())
    assert merit(lin, 10.0) == pytest.approx(
        lin.iterate.total_dv + 7.0 * miss + 10.0 * limits, abs=1e-6
    )
