"""Limits of corrected burns: kept by draws with the probability, with true derivatives."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.special import ndtr

from formulations.arrays import Array
from formulations.linearisation.linearisation import condense
from formulations.rows.cones import Cones
from formulations.rows.corrected_burns import BATTERY, SIZE, CorrectedBurns, FurtherRows
from formulations.rows.uniform import DeterministicRows
from tests.formulations.program.support import slack
from tests.helpers import Flyby, generators, random_flyby, share_of_examples

pytestmark = pytest.mark.slow

Case = tuple[Flyby, np.random.Generator]


@st.composite
def cases(draw: st.DrawFn) -> Case:
    """A flyby whose corrected burns may be limited to about their size, or point near the Sun."""
    rng = draw(generators)
    flyby = random_flyby(rng, burns=draw(st.integers(2, 4))).corrected(rng)
    feedback = flyby.problem.feedback
    assert feedback is not None
    feedback = replace(feedback, probability=draw(st.floats(0.6, 0.995)))
    limit = float(rng.uniform(0.3, 3.0))
    return replace(flyby, problem=replace(flyby.problem, feedback=feedback, dv_max=limit)), rng


def some_controls(case: Case, spread: float) -> Array:
    flyby, rng = case
    controls = spread * rng.normal(size=flyby.problem.controls_before[-1])
    controls[flyby.problem.burn_controls] = flyby.burns
    return controls


def margins(flyby: Flyby, controls: Array) -> Array:
    found = CorrectedBurns(flyby.problem, 0).margins(flyby.at(controls)).values()
    return np.concatenate([one.margin for one in found])


def modelled(blocks: list[Cones], controls: Array) -> Array:
    return np.concatenate([slack(block, controls) for block in blocks])


@given(cases(), st.floats(0.01, 0.3))
def test_margins_are_quantiles_of_distance_to_limits(case, spread):
    """Of drawn commands the required share keeps the limit when it is moved by the margin."""
    flyby, rng = case
    lin, problem = flyby.at(some_controls(case, spread)), flyby.problem
    feedback = problem.feedback
    p, draws = feedback.probability, 10_000
    found = CorrectedBurns(problem, 0).margins(lin)
    xi = rng.normal(size=(draws, 6 * len(feedback.burns)))
    error = 5.0 * np.sqrt(p * (1.0 - p) / draws)
    for j, burn in enumerate(feedback.burns):
        gains = problem.gains_of(lin.iterate, j)
        commands = lin.iterate.burns[burn] + xi[:, : gains.shape[1]] @ gains.T
        sizes = np.linalg.norm(commands, axis=1)
        held = np.mean(sizes <= problem.dv_max - found[SIZE].margin[j])
        assert held == pytest.approx(p, abs=error)
        along, across = commands @ problem.sun[burn], np.cross(commands, problem.sun[burn])
        distance = np.cos(problem.dv_cone) * np.linalg.norm(across, axis=1)
        both = np.stack([distance - np.sin(problem.dv_cone) * sign * along for sign in (1.0, -1.0)])
        failing = np.mean(both < found[BATTERY].margin[j], axis=1).sum()
        assert failing == pytest.approx(1.0 - p, abs=2.0 * error)


@settings(max_examples=share_of_examples(3))
@given(cases(), st.floats(0.01, 0.3))
def test_rows_have_the_margins_value_and_derivative(case, spread):
    flyby, rng = case
    controls, rows = some_controls(case, spread), CorrectedBurns(flyby.problem, 0)
    step = 1e-5 * rng.normal(size=controls.shape)
    blocks = rows.cones(flyby.at(controls))
    assert [block.rows.item() for block in blocks] == list(range(rows.count))
    np.testing.assert_allclose(modelled(blocks, controls), margins(flyby, controls), atol=1e-8)
    slope, expected = (
        (function(about, controls + step) - function(about, controls - step)) / 2e-5
        for function, about in ((modelled, blocks), (margins, flyby))
    )
    np.testing.assert_allclose(slope, expected, rtol=1e-3, atol=2e-3)


@given(cases(), st.floats(0.01, 3.0))
def test_corrections_may_be_along_a_line(case, spread):
    """That of the burn itself, whose law has one dimension and a singular covariance."""
    flyby, rng = case
    problem, controls = replace(flyby.problem, dv_cone=0.0), some_controls(case, 0.0)
    feedback = problem.feedback
    burns, gains = controls[problem.burn_controls[feedback.burns]], []
    sizes = np.linalg.norm(burns, axis=1)
    for j, direction in enumerate(burns / sizes[:, None]):
        row = rng.normal(size=6 * (j + 1))
        gains.append(np.outer(direction, spread * row / np.linalg.norm(row)).ravel())
    controls[problem.gain_controls] = np.concatenate(gains)
    found = CorrectedBurns(problem, 0).margins(replace(flyby, problem=problem).at(controls))
    assert found.keys() == {SIZE}
    limit = problem.dv_max - found[SIZE].margin
    kept = ndtr((limit - sizes) / spread) - ndtr((-limit - sizes) / spread)
    np.testing.assert_allclose(kept, feedback.probability, atol=1e-6)


@given(cases())
def test_without_corrections_margins_are_those_of_the_burns(case):
    """And the rows know what the first gains will cost: they have a kink there."""
    flyby, rng = case
    problem, controls = flyby.problem, some_controls(case, 0.0)
    feedback = problem.feedback
    lin, rows = flyby.at(controls), CorrectedBurns(problem, 0)
    of_burns = problem.burn_margins(lin.iterate.burns)
    found = rows.margins(lin)
    for name, plain in ((SIZE, "dv_max"), (BATTERY, "dv_battery")):
        np.testing.assert_allclose(found[name].margin, of_burns[plain][feedback.burns], atol=1e-8)
    moved = controls.copy()
    moved[problem.gain_controls] = 1e-5 * rng.normal(size=feedback.size)
    after, model = margins(flyby, moved), modelled(rows.cones(lin), moved)
    # Midway between the nappes either may be the nearer one.
    along = np.einsum("ni,ni->n", lin.iterate.burns, problem.sun)[feedback.burns]
    clear = np.concatenate([np.full(len(along), True), np.abs(along) > 0.01])
    np.testing.assert_allclose(model[clear], after[clear], atol=1e-6)


@settings(max_examples=share_of_examples(10))
@given(cases())
def test_rows_follow_final_spread_without_states(case):
    problem = replace(case[0].problem, final_spread=(0.1, None))
    lin = replace(case[0], problem=problem).at(some_controls(case, 0.1))
    rows, own = FurtherRows(problem, 3), CorrectedBurns(problem, 4)
    assert list(rows.margins(lin))[1:] == list(own.margins(lin))
    assert rows.count == 1 + own.count
    blocks = rows.cones(lin, condense(lin))
    assert [block.rows.item() for block in blocks] == list(range(3, 3 + rows.count))
    for block, lifted in zip(blocks[1:], rows.state_cones(lin)[1:], strict=True):
        assert lifted.places.shape == (4, 0)
        np.testing.assert_array_equal(lifted.values, block.values)
        np.testing.assert_array_equal(lifted.constants, block.constants)


def test_zero_burn_is_apex_open_loop_rowless():
    rng = np.random.default_rng(1)
    flyby = random_flyby(rng).corrected(rng)
    lin = flyby.at(np.zeros(flyby.problem.controls_before[-1]))
    found = CorrectedBurns(flyby.problem, 0).margins(lin)
    np.testing.assert_allclose(found[SIZE].margin, flyby.problem.dv_max, atol=1e-8)
    np.testing.assert_allclose(found[BATTERY].margin, 0.0, atol=1e-7)
    assert CorrectedBurns(flyby.problem.open_loop, 0).count == 0
    assert DeterministicRows(flyby.problem).count == 0
