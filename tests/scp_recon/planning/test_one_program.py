"""A plan's conic programs are CVXPY's and nobody else's."""

from dataclasses import dataclass, field
from typing import Any

import clarabel
import cvxpy as cp
import numpy as np
import pytest
from cvxpy.reductions.dcp2cone.cone_matrix_stuffing import ParamConeProg

from formulations.arrays import Array
from formulations.program import condensed
from formulations.program.certificate import ConeProgram
from formulations.program.model import CompiledProgram
from formulations.program.solvers import Answer, Clarabel, Qoco
from scp_recon.mission.mission import Mission
from scp_recon.scp.loop import Record
from scp_recon.scp.status import Status
from tests.scenarios import COARSE
from tests.scp_recon.support import from_cold, mission_of

pytestmark = pytest.mark.slow


@dataclass
class Watched:
    """What was compiled, asked of Clarabel and given to it in a plan; asked so far by iteration."""

    compiled: list[Any] = field(default_factory=list)
    answers: list[Any] = field(default_factory=list)
    read: list[Any] = field(default_factory=list)
    asked: list[ConeProgram] = field(default_factory=list)
    given: list[tuple[Array, Array, Array]] = field(default_factory=list)
    after: list[int] = field(default_factory=list)


def watch(monkeypatch) -> Watched:
    seen = Watched()
    read = CompiledProgram.controls
    compile_, solve, real = cp.Problem.get_problem_data, Clarabel.solve, clarabel.DefaultSolver

    def compiling(self: cp.Problem, *arguments: Any, **options: Any) -> Any:
        found = compile_(self, *arguments, **options)
        seen.compiled.append(found[0][cp.settings.PARAM_PROB])
        return found

    def asking(self: Clarabel, program: ConeProgram) -> Answer:
        seen.asked.append(program)
        answer = solve(self, program)
        seen.answers.append(answer.x)
        return answer

    def reading(self: CompiledProgram, x: Any) -> Any:
        seen.read.append(x)
        return read(self, x)

    class Given:
        """Clarabel itself, and the numbers that it gets."""

        def __init__(self, p: Any, q: Any, a: Any, b: Any, cones: Any, settings: Any) -> None:
            assert p.nnz == 0
            seen.given.append((q.copy(), a.data.copy(), b.copy()))
            self._solver = real(p, q, a, b, cones, settings)

        def update(self, *, q: Any, A: Any, b: Any) -> None:
            seen.given.append((q.copy(), A.copy(), b.copy()))
            self._solver.update(q=q, A=A, b=b)

        def solve(self) -> Any:
            return self._solver.solve()

    def never(*_: object) -> Answer:
        raise AssertionError("no other solver is needed here")

    monkeypatch.setattr(cp.Problem, "get_problem_data", compiling)
    monkeypatch.setattr(Clarabel, "solve", asking)
    monkeypatch.setattr(CompiledProgram, "controls", reading)
    monkeypatch.setattr(Qoco, "solve", never)
    monkeypatch.setattr(clarabel, "DefaultSolver", Given)
    condensed.compile_condensed.cache_clear()
    return seen


def assert_cvxpys_own(seen: Watched) -> None:
    """Every iteration is solved with exactly the numbers that CVXPY's compiled form gives."""
    assert all(after > before for before, after in zip([0, *seen.after], seen.after, strict=False))
    # The burns are read from Clarabel's answers in turn, and from nothing else: all but of failures.
    answers = iter(seen.answers)
    assert len(seen.read) >= len(seen.after)
    assert all(any(x is answer for answer in answers) for x in seen.read)
    # Clarabel got what it was asked, once each, without zeros, and nothing besides.
    assert len(seen.given) == len(seen.asked) >= len(seen.after)
    for program, (q, data, b) in zip(seen.asked, seen.given, strict=True):
        assert isinstance(program.form, ParamConeProg)
        assert any(program.form is form for form in seen.compiled)
        assert np.array_equal(q, program.cost)
        assert np.array_equal(data, program.matrix.data[program.matrix.data != 0.0])
        assert np.array_equal(b, program.bound)


@pytest.fixture(scope="module")
def coarse() -> Mission:
    return mission_of(COARSE)


@pytest.mark.parametrize("formulation", ["condensed", "lifted"])
def test_every_iteration_solves_cvxpys_compiled_form(coarse, formulation, monkeypatch):
    seen, iterations = watch(monkeypatch), list[Record]()

    def observe(_: str, record: Record) -> None:
        iterations.append(record)
        seen.after.append(len(seen.asked))

    found = from_cold(coarse, formulation=formulation, observe=observe)
    assert found.final.result.status is Status.CONVERGED
    assert len(iterations) == sum(len(stage.result.records) for stage in found.stages)
    assert_cvxpys_own(seen)
