"""A name of a formulation and one of a solver make the subproblem that is meant."""

import numpy as np
import pytest

from formulations.linearisation.linearisation import CONDENSATIONS
from formulations.program import condensed, lifted
from formulations.program.condensed import CondensedSubproblem
from formulations.registry import FORMULATIONS, make_subproblem

from .program.support import every_row, linearised


def test_the_solver_is_the_one_required_and_form_and_penalty_are_else_the_usual_ones(monkeypatch):
    asked: list[str] = []
    for module in (condensed, lifted):
        monkeypatch.setattr(module, "FallbackSolver", lambda name, *_: asked.append(name))
    lin = linearised(np.random.default_rng(3))
    rows = every_row(lin, "P2")
    for formulation in FORMULATIONS:
        make_subproblem(lin.problem, rows, formulation, "QOCO")
    usual = make_subproblem(lin.problem, rows)
    assert asked == [*len(FORMULATIONS) * ["QOCO"], "CLARABEL"]
    assert isinstance(usual, CondensedSubproblem)
    assert usual._condense is CONDENSATIONS["condensed"]
    assert (usual.problem, usual.rows, usual._penalty) == (lin.problem, rows, "exact")


def test_every_condensation_is_a_formulation_and_others_are_refused():
    assert set(FORMULATIONS) == {"lifted", *CONDENSATIONS}
    lin = linearised(np.random.default_rng(3))
    with pytest.raises(KeyError, match="unheard of"):
        make_subproblem(lin.problem, every_row(lin, "P3"), "unheard of")
