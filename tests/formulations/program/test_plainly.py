"""Every formulation has the solution of the program said plainly, row by row, in CVXPY."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings

from formulations.linearisation.linearisation import CONDENSATIONS
from formulations.program.subproblem import Penalty
from formulations.registry import FORMULATIONS, make_subproblem
from tests.helpers import generators, share_of_examples

from .support import (
    PENALTIES,
    charge_for,
    every_row,
    linearised,
    minimum,
    solve_plainly,
    tighten,
)

RADIUS = 0.8


@pytest.fixture(autouse=True)
def tight(monkeypatch: pytest.MonkeyPatch) -> None:
    tighten(monkeypatch)


@pytest.mark.parametrize("penalty", PENALTIES)
@pytest.mark.parametrize("name", ["P3", "P2"])
@pytest.mark.parametrize("formulation", FORMULATIONS)
@settings(max_examples=share_of_examples(250, usual=1))
@given(generators)
def test_the_program_has_the_plain_programs_solution(
    formulation: str, name: str, penalty: Penalty, rng: np.random.Generator
) -> None:
    lin = linearised(rng)
    rows = every_row(lin, name)
    charge = charge_for(penalty, rows, lin)
    subproblem = make_subproblem(lin.problem, rows, formulation, penalty=penalty)
    subproblem.update(lin)
    step = subproblem.solve(RADIUS, charge)
    condensation = CONDENSATIONS.get(formulation, CONDENSATIONS["condensed"])
    plain = solve_plainly(lin, rows, RADIUS, penalty, charge, condensation)
    # A minimum is known better than where it is. Where squares are charged the conic solver itself
    # is no better than this.
    rel = 1e-7 if penalty == "exact" else 1e-6
    assert minimum(step, lin, charge) == pytest.approx(plain.value, rel=rel)
    assert step.burns == pytest.approx(plain.burns, abs=1e-3)
