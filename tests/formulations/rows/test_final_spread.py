"""Limits on the covariance after the last burn: their margins, their cones, and how they pull."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from formulations.linearisation.linearisation import (
    Linearisation,
    condense,
)
from formulations.rows.cones import FINAL_POSITION, FINAL_VELOCITY, FinalSpread, Pulled
from tests.helpers import generators, random_flyby

PARTS = {FINAL_POSITION: slice(0, 3), FINAL_VELOCITY: slice(3, 6)}
limits = st.none() | st.floats(0.05, 2.0)


def flown(rng: np.random.Generator, *spread: float | None) -> Linearisation:
    flyby = random_flyby(rng)
    problem = replace(flyby.problem, final_spread=spread)
    return replace(flyby, problem=problem).perturbed(rng, 0.1, 0.0)


@given(generators, limits, limits, st.integers(0, 5))
def test_each_limit_is_one_row_after_the_others_with_the_root_of_the_summed_variances(
    rng: np.random.Generator, position: float | None, velocity: float | None, first: int
) -> None:
    lin = flown(rng, position, velocity)
    rows, last = FinalSpread(lin.problem, first), lin.problem.n_nodes - 1
    wanted = {
        name: limit
        for name, limit in zip(PARTS, (position, velocity), strict=True)
        if limit is not None
    }
    assert rows.count == len(wanted)
    assert rows.nodes.tolist() == ([last] if wanted else [])
    margins, variances = rows.margins(lin), np.diag(lin.factor[-1] @ lin.factor[-1].T)
    assert list(margins) == list(wanted)
    for name, limit in wanted.items():
        expected = limit - np.sqrt(variances[PARTS[name]].sum())
        assert margins[name].nodes.tolist() == [last]
        assert margins[name].margin == pytest.approx([expected], abs=1e-12)
    # The cones: exact in the burns, of the factor's affine model, wherever these are.
    s = condense(lin, np.array([0, last]))
    cones = rows.cones(lin, s)
    assert [int(cone.rows[0]) for cone in cones] == [first + k for k in range(len(wanted))]
    burns = lin.iterate.burns + rng.normal(size=lin.iterate.burns.shape)
    factor = s.factor_constant[-1] + s.factor_jacobian[-1] @ burns.ravel()
    for cone, (name, limit) in zip(cones, wanted.items(), strict=True):
        (y,) = cone.at(burns.ravel())
        assert cone.triangular
        assert y[0] == pytest.approx(limit, abs=1e-12)
        assert np.linalg.norm(y[1:]) == pytest.approx(np.linalg.norm(factor[PARTS[name]]), rel=1e-9)


@given(generators, st.integers(0, 4), st.booleans())
def test_what_pulls_is_the_derivative_of_the_root_at_its_price(
    rng: np.random.Generator, first: int, certain: bool
) -> None:
    """By differences of margins, on top of what the rows before pull."""
    lin = flown(rng, 0.3, 0.2)
    rows, prices = FinalSpread(lin.problem, first), rng.uniform(0.5, 2.0, first + 2)
    n, columns = lin.problem.n_nodes, lin.factor.shape[2]
    before = Pulled(rng.normal(size=(n, 3)), rng.normal(size=(n, 3, columns - 1)))
    if certain:
        lin.__dict__["factor"] = np.zeros_like(lin.factor)
    found = rows.pulled(before, lin, prices)
    assert found.by_mean is before.by_mean
    own = found.by_factor.copy()
    own[:, :3, : columns - 1] -= before.by_factor
    assert own.shape == (n, 6, columns)
    assert not own[:-1].any()
    if certain:
        assert not own[-1].any()
        return
    move, h = rng.normal(size=(6, columns)), 1e-6

    def priced(step: float) -> float:
        other = Linearisation(lin.problem, lin.iterate, lin.arcs)
        other.__dict__["factor"] = lin.factor + step * move
        return -sum(
            price * part.margin.item()
            for price, part in zip(prices[first:], rows.margins(other).values(), strict=True)
        )

    slope = (priced(h) - priced(-h)) / (2.0 * h)
    assert np.sum(own[-1] * move) == pytest.approx(slope, rel=1e-6, abs=1e-8)


def test_without_a_limit_nothing_is_added() -> None:
    lin = flown(np.random.default_rng(0), None, None)
    before = Pulled(np.zeros((9, 3)), np.zeros((9, 3, 2)))
    rows = FinalSpread(lin.problem, 3)
    assert rows.pulled(before, lin, np.zeros(3)) is before
    assert (rows.margins(lin), rows.cones(lin, condense(lin))) == ({}, [])
