"""A name of a formulation and one of a solver make the subproblem that is meant."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from formulations.linearisation.condensation import CONDENSATIONS
from formulations.program import condensed, lifted
from formulations.program.condensed import CondensedSubproblem
from formulations.program.lifted import LiftedSubproblem
from formulations.program.solvers import FallbackSolver
from formulations.program.subproblem import Penalty
from formulations.registry import FORMULATIONS, make_subproblem
from formulations.rows.uniform import DeterministicRows

from .program.support import PENALTIES, every_row, linearised, need


@pytest.mark.parametrize("penalty", PENALTIES)
@pytest.mark.parametrize("solver", ["CLARABEL", "QOCO", "ECOS", "SCS"])
@pytest.mark.parametrize("formulation", FORMULATIONS)
def test_the_form_the_solver_the_rows_and_the_penalty_are_those_asked_for(
    formulation: str, solver: str, penalty: Penalty, monkeypatch: pytest.MonkeyPatch
) -> None:
    need(solver)
    asked: list[str] = []

    def watch(name: str, *settings: Any) -> FallbackSolver:
        asked.append(name)
        return FallbackSolver(name, *settings)

    for module in (condensed, lifted):
        monkeypatch.setattr(module, "FallbackSolver", watch)
    lin = linearised(np.random.default_rng(3))
    rows = every_row(lin, "P2")
    made = make_subproblem(lin.problem, rows, formulation, solver, penalty)
    assert isinstance(made, LiftedSubproblem if formulation == "lifted" else CondensedSubproblem)
    assert made.problem is lin.problem
    assert made.rows is rows
    assert made._penalty == penalty
    if isinstance(made, CondensedSubproblem):
        assert made._condense is CONDENSATIONS[formulation]
    assert asked == [solver]


def test_the_condensed_form_by_clarabel_under_the_exact_penalty_is_the_default(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    asked: list[str] = []
    monkeypatch.setattr(condensed, "FallbackSolver", asked.append)
    lin = linearised(np.random.default_rng(3))
    made = make_subproblem(lin.problem, DeterministicRows(lin.problem))
    assert isinstance(made, CondensedSubproblem)
    assert made._condense is CONDENSATIONS["condensed"]
    assert (asked, made._penalty) == (["CLARABEL"], "exact")


def test_every_condensation_is_a_formulation() -> None:
    assert set(FORMULATIONS) == {"lifted", *CONDENSATIONS}


def test_an_unknown_formulation_is_refused() -> None:
    lin = linearised(np.random.default_rng(3))
    with pytest.raises(KeyError, match="unheard of"):
        make_subproblem(lin.problem, DeterministicRows(lin.problem), "unheard of")
