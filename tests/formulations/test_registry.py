"""A name of a formulation and one of a solver make the subproblem that is meant."""

import numpy as np
import pytest

from formulations.linearisation.linearisation import CONDENSATIONS
from formulations.program import condensed, lifted
from formulations.program.condensed import CondensedSubproblem
from formulations.program.lifted import LiftedSubproblem
from formulations.registry import FORMULATIONS, make_subproblem

from .program.support import PENALTIES, every_row, linearised


@pytest.mark.parametrize("formulation", FORMULATIONS)
def test_the_form_the_solver_the_rows_and_the_penalty_are_those_required(formulation, monkeypatch):
    asked: list[str] = []
    for module in (condensed, lifted):
        monkeypatch.setattr(module, "FallbackSolver", lambda name, *_: asked.append(name))
    lin = linearised(np.random.default_rng(3))
    rows = every_row(lin, "P2")
    for penalty in PENALTIES:
        made = make_subproblem(lin.problem, rows, formulation, "QOCO", penalty)
        assert isinstance(
            made, LiftedSubproblem if formulation == "lifted" else CondensedSubproblem
        )
        assert (made.problem, made.rows, made._penalty) == (lin.problem, rows, penalty)
        if isinstance(made, CondensedSubproblem):
            assert made._condense is CONDENSATIONS[formulation]
    assert asked == ["QOCO"] * len(PENALTIES)
    usual = make_subproblem(lin.problem, rows)
    assert isinstance(usual, CondensedSubproblem)
    assert usual._condense is CONDENSATIONS["condensed"]
    assert (asked[-1], usual._penalty) == ("CLARABEL", "exact")


def test_every_condensation_is_a_formulation_and_others_are_refused():
    assert set(FORMULATIONS) == {"lifted", *CONDENSATIONS}
    lin = linearised(np.random.default_rng(3))
    with pytest.raises(KeyError, match="unheard of"):
        make_subproblem(lin.problem, every_row(lin, "P3"), "unheard of")
