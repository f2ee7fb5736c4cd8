"""In every form the program is the one said plainly, of the iterate, radius and charge at hand."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings

from formulations.arrays import Array
from formulations.linearisation.linearisation import CONDENSATIONS, Linearisation
from formulations.program.model import penalty_values
from formulations.program.subproblem import (
    DYNAMICS_WEIGHT,
    Penalty,
    PenaltyParameters,
    SubproblemError,
)
from formulations.registry import FORMULATIONS, make_subproblem
from tests.helpers import generators, share_of_examples

from .support import (
    PENALTIES,
    charge_for,
    every_row,
    linearised,
    minimum,
    need,
    small,
    solve_plainly,
    tighten,
)


def elsewhere(lin: Linearisation) -> Linearisation:
    """The same arcs around other burns and means."""
    rng = np.random.default_rng(11)
    burns = lin.iterate.burns + 0.1 * rng.normal(size=lin.iterate.burns.shape)
    mean = lin.iterate.mean + 0.05 * rng.normal(size=lin.iterate.mean.shape)
    return Linearisation(lin.problem, replace(lin.iterate, burns=burns, mean=mean), lin.arcs)


@pytest.mark.parametrize("penalty", PENALTIES)
@pytest.mark.parametrize("name", ["P3", "P2"])
@pytest.mark.parametrize("formulation", FORMULATIONS)
@settings(max_examples=share_of_examples(250, usual=1))
@given(generators)
def test_the_program_has_the_solution_of_the_one_said_plainly(
    formulation: str, name: str, penalty: Penalty, rng: np.random.Generator
) -> None:
    """Row by row, in CVXPY."""
    lin = linearised(rng)
    rows = every_row(lin, name)
    charge = charge_for(penalty, rows, lin)
    with pytest.MonkeyPatch.context() as patch:
        tighten(patch)
        subproblem = make_subproblem(lin.problem, rows, formulation, penalty=penalty)
        subproblem.update(lin)
        step = subproblem.solve(0.8, charge)
    condensation = CONDENSATIONS.get(formulation, CONDENSATIONS["condensed"])
    plain = solve_plainly(lin, rows, 0.8, penalty, charge, condensation)
    # A minimum is known better than where it is. Where squares are charged the conic solver itself
    # is no better than this.
    rel = 1e-7 if penalty == "exact" else 1e-6
    assert minimum(step, lin, charge) == pytest.approx(plain.value, rel=rel)
    assert step.burns == pytest.approx(plain.burns, abs=1e-3)


@pytest.mark.parametrize("penalty", PENALTIES)
@pytest.mark.parametrize("name", ["P3", "P2"])
@pytest.mark.parametrize("formulation", FORMULATIONS)
def test_an_updated_program_is_a_new_one(formulation: str, name: str, penalty: Penalty) -> None:
    """Every parameter is set again: nothing is left of the last iterate, radius and charge."""
    lin = small()
    rows, moved = every_row(lin, name, 4), elsewhere(lin)
    used, fresh = (
        make_subproblem(lin.problem, rows, formulation, penalty=penalty) for _ in range(2)
    )
    used.update(lin)
    used.solve(0.1, charge_for(penalty, rows, lin, 3.0))
    charge = charge_for(penalty, rows, lin, 20.0)
    for subproblem in (used, fresh):
        subproblem.update(moved)
    again, new = used.solve(0.5, charge), fresh.solve(0.5, charge)
    assert again.merit == pytest.approx(new.merit, rel=1e-6)
    assert again.burns == pytest.approx(new.burns, abs=1e-3)
    assert np.abs(again.burns - moved.iterate.burns).max() <= 0.5 + 1e-6


@pytest.mark.parametrize("formulation", FORMULATIONS)
@pytest.mark.parametrize("solver", ["CLARABEL", "ECOS"])
def test_dynamics_without_finite_derivatives_are_refused(formulation: str, solver: str) -> None:
    need(solver)
    lin = small()
    stm: Array = np.full_like(lin.arcs.stm, np.nan)
    broken = Linearisation(lin.problem, lin.iterate, replace(lin.arcs, stm=stm))
    subproblem = make_subproblem(lin.problem, every_row(lin, "P3", 4), formulation, solver)
    with (
        np.errstate(invalid="ignore"),
        pytest.raises(SubproblemError, match="no finite derivatives at the iterate"),
    ):
        subproblem.update(broken)


# --- its parameters -----------------------------------------------------------------------------


def test_prices_are_those_of_the_charge_each_at_its_place() -> None:
    """Misses first, then limits of the burns, then the buffers of the rows that have one."""
    m, rows = 2, np.array([3, 0, -1, 2])
    limits = 6 + 3 * m
    exact = penalty_values("exact", PenaltyParameters(5.0), m, rows)
    assert list(exact) == ["prices"]
    assert exact["prices"].tolist() == [DYNAMICS_WEIGHT * 5.0] * 6 + [5.0] * (3 * m + 4)
    proximal = penalty_values("proximal", PenaltyParameters(5.0, prox=3.0), m, rows)
    assert np.array_equal(proximal["prices"], exact["prices"])
    assert proximal["curvature"] == 1.5
    multipliers = np.arange(1.0, limits + 5.0)
    charge = PenaltyParameters(5.0, multipliers=multipliers)
    augmented = penalty_values("augmented", charge, m, rows)
    assert augmented["curvature"] == 2.5
    own = [multipliers[limits + 3], multipliers[limits], 0.0, multipliers[limits + 2]]
    assert augmented["prices"].tolist() == [*multipliers[:limits], *own]
