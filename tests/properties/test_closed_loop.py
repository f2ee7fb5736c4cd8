"""Corrected burns: the closed loop's factor is that of flights, and its derivative is one."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from formulations.arrays import Array
from formulations.linearisation.adjoint import gradient
from formulations.linearisation.linearisation import Linearisation, condense
from formulations.problem.flyby import Iterate
from tests.helpers import Flyby, generators, random_flyby


@st.composite
def corrected_flybys(draw: st.DrawFn) -> tuple[Flyby, np.random.Generator]:
    """Of two to four burns after a coast or none, each but the first corrected."""
    coast, burns, free = draw(st.integers(0, 2)), draw(st.integers(2, 4)), draw(st.integers(1, 4))
    rng = draw(generators)
    flyby = random_flyby(rng, nodes=coast + burns + free, burns=burns, coast=coast)
    return flyby.corrected(rng), rng


def linearised(flyby: Flyby, controls: Array) -> Linearisation:
    """About burns and gains, flown."""
    problem = flyby.problem
    mean = flyby.waves.rollout(problem, controls[problem.burn_controls]).mean
    iterate = Iterate(controls[problem.burn_controls], mean, controls[problem.gain_controls])
    return flyby.waves.linearise(problem, iterate)


def some_controls(flyby: Flyby, rng: np.random.Generator) -> Array:
    problem = flyby.problem
    controls = 0.02 * rng.normal(size=problem.controls_before[-1])
    controls[problem.burn_controls] = flyby.burns + 0.3 * rng.normal(size=flyby.burns.shape)
    return controls


@given(corrected_flybys())
def test_condense_is_the_derivative_by_burns_and_gains(
    case: tuple[Flyby, np.random.Generator],
) -> None:
    flyby, rng = case
    controls, h = some_controls(flyby, rng), 1e-6
    direction = rng.normal(size=controls.shape)
    s = condense(linearised(flyby, controls))
    ahead, behind = (linearised(flyby, controls + t * direction) for t in (h, -h))
    mean = (ahead.iterate.mean - behind.iterate.mean) / (2.0 * h)
    factor = (ahead.factor - behind.factor) / (2.0 * h)
    np.testing.assert_allclose(s.mean_jacobian @ direction, mean, rtol=1e-6, atol=1e-7)
    size = max(1.0, float(np.abs(factor).max()))
    np.testing.assert_allclose(s.factor_jacobian @ direction, factor, rtol=1e-5, atol=1e-6 * size)


@given(corrected_flybys())
def test_flights_of_linear_arcs_with_a_kalman_filter_of_their_own_have_the_factors_covariance(
    case: tuple[Flyby, np.random.Generator],
) -> None:
    """Every source of errors, one at a time, through the textbook's filter and the gains.

    The second moment of the correction's errors of execution comes in as a source of its own.
    """
    flyby, rng = case
    problem = flyby.problem
    feedback = problem.feedback
    assert feedback is not None
    lin = linearised(flyby, some_controls(flyby, rng))
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
                spread = np.sqrt(np.diag(gains @ gains.T))
                added[:, problem.columns_of_correction(j)[0]] = errors.fraction * np.diag(spread)  # type: ignore[attr-defined]
                command = gains @ np.vstack(numbers[: j + 1])
                state[3:] += command
                estimate[3:] += command
            state[3:] += added
            knowledge[3:, 3:] += added @ added.T
        found[node] = state
    np.testing.assert_allclose(lin.factor, found, rtol=1e-6, atol=1e-8)


@given(corrected_flybys())
def test_a_correction_knows_only_what_was_measured_by_its_cut_off(
    case: tuple[Flyby, np.random.Generator],
) -> None:
    """A burn's velocity does not depend on sources that enter after its cut-off."""
    flyby, rng = case
    problem = flyby.problem
    feedback = problem.feedback
    assert feedback is not None
    controls = some_controls(flyby, rng)
    lin = linearised(flyby, controls)
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


@given(corrected_flybys())
def test_the_adjoint_gives_the_condensed_maps_derivative(
    case: tuple[Flyby, np.random.Generator],
) -> None:
    flyby, rng = case
    lin = linearised(flyby, some_controls(flyby, rng))
    by_mean = rng.normal(size=lin.iterate.mean.shape)
    by_factor = rng.normal(size=lin.factor.shape)
    s = condense(lin)
    expected = np.einsum("ni,niz->z", by_mean, s.mean_jacobian)
    expected += np.einsum("nic,nicz->z", by_factor, s.factor_jacobian)
    found = gradient(lin, by_mean, by_factor)
    np.testing.assert_allclose(found, expected, rtol=1e-7, atol=1e-8 * np.abs(expected).max())
