"""Corrected burns: covariances of flights with a filter; IPOPT's programs against the convex side."""

from dataclasses import replace
from typing import get_args

import casadi as ca
import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st
from scipy.optimize import brentq

from formulations.arrays import Array
from formulations.linearisation.linearisation import condense
from formulations.nlp.program import Arcs, Start
from formulations.problem.controls import Cost
from formulations.problem.execution_errors import ComponentwiseErrors, GatesErrors
from formulations.rows.corrected_burns import BATTERY, SIZE, margins_of
from formulations.rows.uniform import ChanceRows
from tests.formulations.program.support import assert_transposed, every_row, slope_of
from tests.helpers import Flyby, Waves, constrain, generators, random_flyby, share_of_examples
from tests.oracles.closed_loop import LEAST, corrected_shooting

GATES = GatesErrors(0.004, 0.02, 0.003, 0.03)


@st.composite
def corrected_flybys(draw: st.DrawFn) -> tuple[Flyby, np.random.Generator]:
    """Of two to four burns after a coast or none, each but the first corrected."""
    coast, burns, free = draw(st.integers(0, 2)), draw(st.integers(2, 4)), draw(st.integers(1, 4))
    rng = draw(generators)
    flyby = random_flyby(rng, nodes=coast + burns + free, burns=burns, coast=coast)
    if draw(st.booleans()):
        flyby = replace(flyby, problem=replace(flyby.problem, execution_errors=GATES))
    return flyby.corrected(rng), rng


def some_controls(flyby: Flyby, rng: np.random.Generator) -> Array:
    problem = flyby.problem
    controls = 0.02 * rng.normal(size=problem.controls_before[-1])
    controls[problem.burn_controls] = flyby.burns + 0.3 * rng.normal(size=flyby.burns.shape)
    return controls


@given(corrected_flybys())
def test_condense_is_the_derivative_by_burns_and_gains(case):
    flyby, rng = case
    controls, h = some_controls(flyby, rng), 1e-6
    direction = rng.normal(size=controls.shape)
    s = condense(flyby.at(controls))
    ahead, behind = (flyby.at(controls + t * direction) for t in (h, -h))
    mean = (ahead.iterate.mean - behind.iterate.mean) / (2.0 * h)
    factor = (ahead.factor - behind.factor) / (2.0 * h)
    np.testing.assert_allclose(s.mean_jacobian @ direction, mean, rtol=1e-6, atol=1e-7)
    size = max(1.0, float(np.abs(factor).max()))
    np.testing.assert_allclose(s.factor_jacobian @ direction, factor, rtol=1e-5, atol=1e-6 * size)
    assert_transposed(flyby.at(controls), rng)


@given(corrected_flybys())
def test_kalman_filtered_flights_have_factors_covariance(case):
    """Every source of errors, one at a time, through the textbook's filter and the gains.

    The second moment of the correction's errors of execution comes in as a source of its own.
    """
    flyby, rng = case
    problem = flyby.problem
    feedback = problem.feedback
    lin = flyby.at(some_controls(flyby, rng))
    found = np.zeros_like(lin.factor)
    sources, errors = problem.factor_columns, problem.execution_errors
    state = np.pad(problem.initial_factor, ((0, 0), (0, sources - problem.initial_factor.shape[1])))
    estimate, knowledge = np.zeros_like(state), problem.initial_factor @ problem.initial_factor.T
    numbers: list[Array] = []  # innovations, as maps of the sources
    for node in range(problem.n_nodes):
        if node:
            stm = lin.arcs.stm[node - 1]
            state, estimate, knowledge = stm @ state, stm @ estimate, stm @ knowledge @ stm.T
        for j in np.flatnonzero(feedback.cut_offs == node):
            noise = np.zeros_like(state)
            noise[:, problem.columns_of_correction(j)[1]] = feedback.measurement[j]
            covariance = knowledge + feedback.measurement[j] @ feedback.measurement[j].T
            gain = knowledge @ np.linalg.inv(covariance)
            surprise = state + noise - estimate
            estimate = estimate + gain @ surprise
            knowledge = (np.eye(6) - gain) @ knowledge
            numbers.append(np.linalg.solve(np.linalg.cholesky(covariance), surprise))
        for i in np.flatnonzero(problem.burn_nodes == node):
            added = np.zeros((3, sources))
            added[:, problem.columns_of_burn(i)] = errors.columns(lin.iterate.burns[i : i + 1])[0]
            if i in feedback.burns:
                j = int(np.searchsorted(feedback.burns, i))
                gains = problem.gains_of(lin.iterate, j)
                if errors is GATES:
                    own, _ = errors.correction_columns(gains)
                else:
                    own = errors.fraction * np.diag(np.sqrt(np.diag(gains @ gains.T)))
                added[:, problem.columns_of_correction(j)[0]] = own
                command = gains @ np.vstack(numbers[: j + 1])
                state[3:] += command
                estimate[3:] += command
            state[3:] += added
            knowledge[3:, 3:] += added @ added.T
        found[node] = state
    np.testing.assert_allclose(lin.factor, found, rtol=1e-6, atol=1e-8)


@given(corrected_flybys())
def test_correction_uses_measurements_before_cut_off(case):
    """A burn's velocity does not depend on sources that enter after its cut-off."""
    flyby, rng = case
    problem = flyby.problem
    feedback = problem.feedback
    controls = some_controls(flyby, rng)
    lin = flyby.at(controls)
    for j in range(len(feedback.burns)):
        known = np.vstack([one.rows for one in lin.spread.innovations[: j + 1]])
        np.testing.assert_allclose(known @ known.T, np.eye(len(known)), atol=1e-9)
        for i in range(problem.n_burns):
            if problem.burn_nodes[i] >= feedback.cut_offs[j]:
                assert not known[:, problem.columns_of_burn(i)].any()
        for later in range(j + 1, len(feedback.burns)):
            assert not known[:, problem.columns_of_correction(later)[1]].any()
    without = replace(lin.iterate, gains=np.zeros(0))
    silent = flyby.waves.linearise(problem, without)
    plain = flyby.waves.linearise(replace(problem, feedback=None), without)
    for i in range(problem.n_burns):
        mine, own = problem.columns_of_burn(i), plain.problem.columns_of_burn(i)
        np.testing.assert_allclose(silent.factor[..., mine], plain.factor[..., own])


@given(corrected_flybys(), st.lists(st.floats(-3.0, 12.0), min_size=6, max_size=6))
def test_gains_act_on_what_estimates_resolve(case, exponents):
    """In any ratio: commands follow from estimates, and what is left out tells next to nothing."""
    flyby, rng = case
    feedback = flyby.problem.feedback
    errors = 10.0 ** np.array(exponents)[:, None] * feedback.measurement
    problem = replace(flyby.problem, feedback=replace(feedback, measurement=errors))
    lin = replace(flyby, problem=problem).at(some_controls(flyby, rng)).informed
    for j, one in enumerate(lin.spread.innovations):
        last = problem.gains_of(lin.iterate, j)[:, -6:]
        estimated = last @ one.by_estimate(one.gain)
        np.testing.assert_allclose(estimated, last, atol=1e-9 * np.abs(last).max())
        error = lin.spread.stm[feedback.cut_offs[j]] @ lin.spread.errors[j]
        told = one.axes @ one.axes.T
        silent = np.linalg.solve(one.root, error) - told @ np.linalg.solve(one.root, error)
        assert np.linalg.norm(silent, 2) <= 1e-3


MODELS = [ComponentwiseErrors(0.05), GATES, replace(GATES, magnitude_bias=0.04)]


def casadi_arcs(waves: Waves) -> Arcs:
    """The same arcs over symbols; an arc's duration is its number."""
    x, k = ca.SX.sym("x", 6), ca.SX.sym("k")
    parts = zip(waves.linear, waves.amplitude, waves.frequency, strict=True)
    ends = [ca.DM(a) @ x + ca.DM(w) @ ca.sin(ca.DM(v) @ x) for a, w, v in parts]
    end = sum(((k == i) * end for i, end in enumerate(ends)), ca.SX(6, 1))
    return Arcs(ca.Function("flow", [x, k], [end]), np.arange(len(ends), dtype=float))


@pytest.mark.slow
@pytest.mark.parametrize("price", get_args(Cost))
@given(generators, st.sampled_from(MODELS))
@example(np.random.default_rng(1), MODELS[1])
@settings(max_examples=share_of_examples(30, usual=1))
def test_rows_cost_gradient_match_convex_program(price, rng, errors):
    """Whatever the burns and gains: the two are one problem. Gradients are CasADi's own."""
    coast, burns = int(rng.integers(0, 2)), 2 if errors.shared else 3
    flyby = random_flyby(rng, nodes=7, burns=burns, coast=coast)
    flyby = constrain(rng, flyby).corrected(rng, price)
    problem = replace(flyby.problem, execution_errors=errors)
    burns = flyby.burns + 0.1 * rng.normal(size=flyby.burns.shape)
    gains = 0.1 * rng.normal(size=len(problem.gain_controls))
    lin = replace(flyby, problem=problem).flown(burns, gains)
    rows = every_row(lin, "P2", 4)
    assert isinstance(rows, ChanceRows)
    start = Start(lin.iterate, lin.factor)
    program = corrected_shooting(problem, casadi_arcs(flyby.waves), rows.facets, start)
    own, x, point = len(lin.controls), program.unknowns, program.start.copy()
    blocks = {block.name: block.value for block in program.blocks}

    def settle(name: str, place: slice) -> None:
        """Set unknowns t with rows t - s^2 / t to s."""
        t = point[place]
        point[place] = np.sqrt(t * (t - program.residuals(point)[name]))

    settle("sizes", slice(own, own + blocks["sizes"].numel()))
    if price == "dv99":
        settle("width", slice(len(point) - 2, len(point) - 1))
        off = ca.Function("off", [x], [blocks["quantile"]])
        tail = brentq(lambda t: float(off(np.r_[point[:-1], t])), 1.0, 5.0, xtol=1e-14)
        point[-1] = tail
    found = program.iterate(point)
    np.testing.assert_allclose(found.mean, lin.iterate.mean, atol=1e-12)
    np.testing.assert_array_equal(found.gains, gains)
    said = program.residuals(point)
    np.testing.assert_allclose(said["sizes"], 0.0, atol=1e-12)
    margins = rows.margins(lin)
    assert margins.keys() < said.keys()
    for name in margins.keys() - {SIZE, BATTERY}:
        np.testing.assert_allclose(said[name], margins[name].margin, rtol=1e-7, atol=1e-7)
    value = float(ca.Function("cost", [x], [program.cost])(point))
    if price != "nominal":
        value -= LEAST * point[own:][1 : 1 + len(problem.feedback.burns)].sum()
    assert value == pytest.approx(lin.cost.value, rel=1e-7)
    # Where the further unknowns are determined by their equations, a row's slope is its own less what
    # these move; cost and weighed rows one after the other.
    prices = {
        name: rng.normal(size=len(margin)) * (name not in (SIZE, BATTERY))
        for name, margin in ((key, one.margin) for key, one in margins.items())
    }
    weighed = sum(ca.dot(ca.DM(price), blocks[name]) for name, price in prices.items())
    further = [blocks[name] for name in ("sizes", "width", "quantile") if name in blocks]
    defined = ca.vertcat(*further)
    slopes = ca.Function(
        "slopes", [x], [ca.jacobian(e, x) for e in (program.cost, weighed, defined)]
    )
    of_cost, of_rows, of_defined = (np.array(slope) for slope in slopes(point))
    moved = -np.linalg.solve(of_defined[:, own:], of_defined[:, :own])
    by_rows = slope_of(lin, rows, np.concatenate([*prices.values()]))
    for slope, expected in ((of_cost, lin.cost.gradient), (of_rows, by_rows)):
        total = slope[0, :own] + slope[0, own:] @ moved
        np.testing.assert_allclose(total, expected, atol=5e-6 * np.abs(expected).max())
    for name in (SIZE, BATTERY):
        slope = np.array(ca.Function("slope", [x], [ca.jacobian(blocks[name], x)])(point))
        check_limits(problem, lin.iterate, name, said[name], slope[:, :own])


def check_limits(problem, iterate, name, said, slope):
    """With the chance to break a limit that IPOPT has, the convex margin is nothing."""
    for j, burn in enumerate(problem.feedback.burns):
        chance = (1.0 - said[j]) * (1.0 - problem.feedback.probability)
        if not 1e-5 < chance < 1.0 - 1e-5:
            continue
        feedback = replace(problem.feedback, probability=1.0 - chance)
        gains = problem.gains_of(iterate, j)
        given = np.array([burn]), iterate.burns[[burn]], gains[None]
        margin = margins_of(replace(problem, feedback=feedback), *given)[name]
        np.testing.assert_allclose(margin.value, 0.0, atol=2e-6 * np.linalg.norm(gains))
        along = np.r_[margin.by_mean[0], margin.by_factor[0, :, : gains.shape[1]].ravel()]
        mine = slope[j, slice(*problem.controls_before[burn : burn + 2])]
        np.testing.assert_allclose(
            mine / np.linalg.norm(mine), along / np.linalg.norm(along), atol=1e-4
        )
