"""Mean, factor and virtual control as variables make the condensed program again."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from formulations.linearisation.linearisation import Linearisation
from formulations.problem.regions import Ball
from formulations.program import convex_subproblem, lifted, solvers
from formulations.program.penalty import Penalty
from formulations.program.solvers import SOLVERS
from formulations.registry import make_subproblem
from formulations.rows.cones import Rows
from tests.helpers import constrain, random_flyby

from .support import PENALTIES, alone, charge_for, every_row, minimum, need, tighten


def linearised(seed: int = 3, **sizes: int) -> Linearisation:
    rng = np.random.default_rng(seed)
    return constrain(rng, random_flyby(rng, **{"nodes": 5, **sizes})).perturbed(rng, 0.1, 0.05)


def rows_of(lin: Linearisation, name: str) -> Rows:
    return every_row(lin, name, 4)


@pytest.mark.parametrize("penalty", PENALTIES)
@pytest.mark.parametrize("name", ["P3", "P2"])
def test_the_lifted_program_is_the_condensed_one(
    name: str, penalty: Penalty, monkeypatch: pytest.MonkeyPatch
) -> None:
    tighten(monkeypatch)
    lin = linearised(5)
    rows, found = rows_of(lin, name), []
    charge = charge_for(penalty, rows, lin)
    for formulation in ("condensed", "lifted"):
        subproblem = make_subproblem(lin.problem, rows, formulation, penalty=penalty)
        subproblem.update(lin)
        found.append(minimum(subproblem.solve(0.8, charge), lin, charge))
    assert found[1] == pytest.approx(found[0], rel=1e-7 if penalty == "exact" else 1e-6)


@pytest.mark.parametrize("seed", range(6))
def test_lifted_rows_may_start_and_end_at_any_node(seed: int) -> None:
    """One constraint at a few nodes: before the first inner burn, after the last, and at burns."""
    flyby = linearised(seed, nodes=8, burns=4)
    one = flyby.problem.constraints[0]
    assert isinstance(one.region, Ball)
    nodes = np.array([[0], [1], [2, 3], [7], [3, 4, 6], [0, 7]][seed])
    region = Ball(np.repeat(one.region.center[:1], len(nodes), axis=0), one.region.radius)
    problem = replace(flyby.problem, constraints=(replace(one, nodes=nodes, region=region),))
    lin = Linearisation(problem, flyby.iterate, flyby.arcs)
    for name in ("P3", "P2"):
        merits = []
        for formulation in ("condensed", "lifted"):
            subproblem = make_subproblem(problem, rows_of(lin, name), formulation)
            subproblem.update(lin)
            merits.append(subproblem.solve(0.5, 10.0).merit)
        assert merits[1] == pytest.approx(merits[0], rel=1e-6)


@pytest.mark.parametrize("penalty", PENALTIES)
@pytest.mark.parametrize("solver", [*SOLVERS, "ECOS"])
def test_conic_solvers_agree(
    penalty: Penalty, solver: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    need(solver)
    lin = linearised()
    rows = rows_of(lin, "P2")
    charge, found = charge_for(penalty, rows, lin), []
    for formulation, by in (("condensed", "CLARABEL"), ("lifted", solver)):
        if by == solver and solver in SOLVERS:
            alone(monkeypatch, solver)
        subproblem = make_subproblem(lin.problem, rows, formulation, by, penalty)
        assert subproblem.rows is rows
        subproblem.update(lin)
        found.append(minimum(subproblem.solve(0.5, charge), lin, charge))
    assert found[1] == pytest.approx(found[0], rel=1e-6)


def test_it_is_compiled_once(monkeypatch: pytest.MonkeyPatch) -> None:
    compiled: list[Any] = []
    real = lifted.CompiledProgram

    def watch(model: Any) -> Any:
        compiled.append(model)
        return real(model)

    monkeypatch.setattr(lifted, "CompiledProgram", watch)
    lin = linearised()
    subproblem = make_subproblem(lin.problem, rows_of(lin, "P2"), "lifted")
    assert compiled == []  # before it is asked
    for size in (0.0, 0.1):
        burns = lin.iterate.burns + size
        subproblem.update(Linearisation(lin.problem, replace(lin.iterate, burns=burns), lin.arcs))
        for radius in (0.1, 0.5):
            subproblem.solve(radius, 10.0)
    assert len(compiled) == 1


def test_clarabels_regularisation_is_what_this_form_needs_and_no_others(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Each solver gets the settings for it; a step is what the solver said."""
    asked: list[tuple[str, Any]] = []
    lin = linearised()

    def recording(name: str) -> Any:
        def make(settings: Any) -> Any:
            asked.append((name, dict(settings)))
            real = solvers.Clarabel(settings)

            def solve(program: Any) -> Any:
                said = real.solve(program)
                return said._replace(accurate=False, solver_s=3.0, multipliers=None)

            return SimpleNamespace(solve=solve)

        return make

    monkeypatch.setitem(SOLVERS, "CLARABEL", recording("CLARABEL"))
    monkeypatch.delitem(SOLVERS, "QOCO")
    for formulation in ("condensed", "lifted"):
        subproblem = make_subproblem(lin.problem, rows_of(lin, "P3"), formulation)
        subproblem.update(lin)
        clock = iter(float(k) for k in range(100))
        for module in (convex_subproblem, lifted):
            monkeypatch.setattr(module, "perf_counter", lambda clock=clock: next(clock))
        step = subproblem.solve(0.5, 10.0)
        assert not step.accurate
        assert step.solver_s >= 6.0  # asked twice, because it was not accurate
        monkeypatch.undo()
        monkeypatch.setitem(SOLVERS, "CLARABEL", recording("CLARABEL"))
        monkeypatch.delitem(SOLVERS, "QOCO")
    settings = {"static_regularization_constant": 1e-7}
    assert asked == [("CLARABEL", {})] * 2 + [("CLARABEL", settings)] * 2
