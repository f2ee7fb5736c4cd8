"""Conic solvers say what they found, a verdict needs a proof, and failures have others behind."""

from __future__ import annotations

import sys
from collections.abc import Callable
from types import SimpleNamespace
from typing import Any

import clarabel
import numpy as np
import pytest
import scipy.sparse as sp
from hypothesis import given
from hypothesis import strategies as st

from formulations import interior_point
from formulations.program.solvers import (
    GAP,
    HUGE,
    SOLVERS,
    Answer,
    Clarabel,
    ConeProgram,
    Qoco,
    Recovering,
    is_optimal,
    outside,
)
from tests.helpers import Array, generators

FREE = ConeProgram(np.zeros(2), sp.csc_array((0, 2)), np.zeros(0), 0, 0, ())


def tent(price: float = 1.0, size: float = 1.0) -> tuple[ConeProgram, Array, Array]:
    """Min price t with t >= ||(x - size, x + size)||, x <= 10 size and y = x; optimum and proof."""
    rows = [[0, 1, -1], [0, 1, 0], [-1, 0, 0], [0, -1, 0], [0, -1, 0]]
    matrix = sp.csc_array(np.array(rows, dtype=float))
    bound = size * np.array([0.0, 10.0, 0.0, -1.0, 1.0])
    program = ConeProgram(price * np.eye(3)[0], matrix, bound, 1, 1, (3,))
    half = np.sqrt(0.5)
    x, z = size * np.array([2.0 * half, 0.0, 0.0]), price * np.array([0.0, 0.0, 1.0, half, -half])
    return program, x, z


def disk(rng: np.random.Generator, equations: int) -> ConeProgram:
    """The lowest point of a disk within a box, on a plane if there is an equation."""
    plane = rng.uniform(0.5, 1.0, (equations, 3))
    matrix = np.vstack([plane, np.eye(3), -np.eye(3), np.zeros((1, 3)), -np.eye(3)])
    bound = np.concatenate([plane @ rng.uniform(-0.2, 0.2, 3), np.ones(6), [1.1], np.zeros(3)])
    return ConeProgram(rng.normal(size=3), sp.csc_array(matrix), bound, equations, 6, (4,))


# --- what proves an optimum ---------------------------------------------------------------------


@given(generators, st.integers(0, 3), st.integers(0, 4), st.lists(st.integers(2, 5), max_size=3))
def test_outside_is_the_worst_of_all_cones(
    rng: np.random.Generator, zero: int, nonnegative: int, cones: list[int]
) -> None:
    y = rng.normal(size=zero + nonnegative + sum(cones))
    program = ConeProgram(
        np.zeros(1), sp.csc_array((len(y), 1)), np.zeros(len(y)), zero, nonnegative, tuple(cones)
    )
    short = [0.0, *(-y[zero : zero + nonnegative])]
    first = zero + nonnegative
    for dimension in cones:
        head, tail = y[first], y[first + 1 : first + dimension]
        short.append(float(np.sqrt(sum(tail**2)) - head))
        first += dimension
    assert outside(program, y) == pytest.approx(max(short), rel=1e-12)


@pytest.mark.parametrize("price", [1e-3, 1.0, 1e3])
@pytest.mark.parametrize("size", [1e-3, 1.0, 1e3])
def test_the_proof_of_an_optimum_holds_in_any_units(price: float, size: float) -> None:
    program, x, z = tent(price, size)
    assert is_optimal(program, x, z)


@pytest.mark.parametrize(
    ("price", "size", "dx", "dz", "scale"),
    [
        # The gradient, against the largest price: a cost, or a multiplier.
        (1.0, 1.0, (0, 0, 0), (1, 0, 0, 0, 0), 1.0),
        (1e3, 1e-3, (0, 0, 0), (1, 0, 0, 0, 0), 1e3),
        (1e-3, 1.0, (0, 0, 0), (1, 0, 0, 0, 0), 1.0),
        # The equation, against the largest number: a bound here.
        (1.0, 1.0, (0, 0, 1), (0, 0, 0, 0, 0), 10.0),
        (1.0, 1e3, (0, 0, -1), (0, 0, 0, 0, 0), 1e4),
        (1.0, 1e-3, (0, 0, 1), (0, 0, 0, 0, 0), 1.0),
        # The second-order cone, where the cost hardly counts.
        (1e-4, 1.0, (-1, 0, 0), (0, 0, 0, 0, 0), 10.0),
        (1e-4, 1e-3, (-1, 0, 0), (0, 0, 0, 0, 0), 1.0),
        # A multiplier's sign, where the bound hardly counts.
        (1.0, 1e-3, (0, 0, 0), (0, -1, 0, -0.5, -0.5), 1.0),
        (1e3, 1e-4, (0, 0, 0), (0, -1, 0, -0.5, -0.5), 1e3),
        # The gap, against the cost where that is above one.
        (1.0, 0.1, (1, 0, 0), (0, 0, 0, 0, 0), 1.0),
        (1.0, 1e3, (1, 0, 0), (0, 0, 0, 0, 0), 1e3 * np.sqrt(2.0)),
    ],
)
def test_each_condition_is_held_to_its_tolerance(
    price: float, size: float, dx: tuple[float, ...], dz: tuple[float, ...], scale: float
) -> None:
    program, x, z = tent(price, size)
    for share, optimal in ((0.9, True), (1.1, False)):
        step = share * GAP * scale
        assert is_optimal(program, x + step * np.array(dx), z + step * np.array(dz)) is optimal


def test_the_largest_number_may_be_a_variable_and_the_largest_price_a_multiplier() -> None:
    """Min x with x = y / 1000 and x >= 1; min x with x / 1000 >= 0."""
    matrix = sp.csc_array(np.array([[1.0, -1e-3], [-1.0, 0.0]]))
    program = ConeProgram(np.array([1.0, 0.0]), matrix, np.array([0.0, -1.0]), 1, 1, ())
    x, z = np.array([1.0, 1e3]), np.array([0.0, 1.0])
    assert is_optimal(program, x, z)
    for share, optimal in ((0.9, True), (1.1, False)):
        assert is_optimal(program, x + share * GAP * np.array([0.0, 1e6]), z) is optimal
    steep = ConeProgram(np.array([1.0]), sp.csc_array([[-1e-3]]), np.array([0.0]), 0, 1, ())
    assert is_optimal(steep, np.zeros(1), np.array([1e3 + 0.9]))
    assert not is_optimal(steep, np.zeros(1), np.array([1e3 + 1.1]))


# --- each solver --------------------------------------------------------------------------------


@pytest.mark.parametrize("equations", [0, 1])
@pytest.mark.parametrize("solver", SOLVERS)
def test_solvers_keep_their_tolerance_and_are_silent(
    solver: str, equations: int, capfd: pytest.CaptureFixture[str]
) -> None:
    if solver == "QOCO":
        pytest.importorskip("qoco", reason="QOCO is not installed")
    rng = np.random.default_rng(3)
    kept = SOLVERS[solver]()
    for _ in range(3):
        program = disk(rng, equations)
        answer = kept.solve(program)
        z = answer.multipliers
        assert z is not None
        assert is_optimal(program, answer.x, z)
        assert program.cost @ answer.x == pytest.approx(-program.bound @ z, abs=1e-8)
        assert outside(program, z) < 1e-8
        assert answer.accurate or solver == "QOCO"  # which is stricter with itself
        assert 0.0 < answer.solver_s < 1.0
    assert capfd.readouterr() == ("", "")


@pytest.mark.parametrize("solver", SOLVERS)
def test_a_wide_tolerance_is_taken_at_its_word(
    solver: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Neither tolerance is left at the solver's own, which is far below this one."""
    if solver == "QOCO":
        pytest.importorskip("qoco", reason="QOCO is not installed")
    program, gaps = disk(np.random.default_rng(5), 0), []
    for tolerance in (1e-9, 1e-1):
        monkeypatch.setattr(interior_point, "TOLERANCE", tolerance)
        answer = SOLVERS[solver]().solve(program)
        assert answer.multipliers is not None
        gaps.append(abs(program.cost @ answer.x + program.bound @ answer.multipliers))
    assert gaps[0] < 1e-8
    assert gaps[1] > 1e-5


def test_clarabel_is_set_up_for_new_numbers_on_one_core(monkeypatch: pytest.MonkeyPatch) -> None:
    """Presolving would make its data final; its threads are ours to give."""
    seen: list[Any] = []
    real = clarabel.DefaultSolver

    def watch(*arguments: Any) -> Any:
        seen.append(arguments)
        return real(*arguments)

    monkeypatch.setattr(clarabel, "DefaultSolver", watch)
    solver = Clarabel()
    for _ in range(2):
        solver.solve(disk(np.random.default_rng(1), 1))
    ((p, q, _, _, cones, settings),) = seen  # built once
    assert p.shape == (len(q), len(q))
    assert p.nnz == 0
    assert len(cones) == 3
    assert settings.presolve_enable is False
    assert settings.verbose is False
    assert settings.max_threads == 1
    tolerances = settings.tol_gap_abs, settings.tol_gap_rel, settings.tol_feas
    assert tolerances == (interior_point.TOLERANCE,) * 3


def test_an_almost_solved_program_is_answered_and_not_vouched_for(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    found = SimpleNamespace(x=[1.0, 2.0, 3.0], z=[4.0], status="AlmostSolved")
    fake = SimpleNamespace(solve=lambda: found)
    monkeypatch.setattr(clarabel, "DefaultSolver", lambda *_: fake)
    answer = Clarabel().solve(disk(np.random.default_rng(1), 0))
    assert (answer.status, answer.accurate) == ("AlmostSolved", False)
    assert list(answer.x) == [1.0, 2.0, 3.0]
    assert answer.multipliers is not None
    assert list(answer.multipliers) == [4.0]


class FakeQoco:
    """QOCO's interface, and what it was given."""

    def __init__(self, status: str) -> None:
        self.given: dict[str, Any] = {}
        self._found = SimpleNamespace(x=[1.0], y=[2.0], z=[3.0, 4.0], status=status)

    def setup(self, *arguments: Any, **settings: Any) -> None:
        self.given["setup"] = arguments, settings

    def update_vector_data(self, **vectors: Any) -> None:
        self.given |= vectors

    def update_matrix_data(self, **matrices: Any) -> None:
        self.given |= matrices

    def solve(self) -> SimpleNamespace:
        return self._found


@pytest.mark.parametrize("equations", [0, 1])
def test_qoco_gets_equations_apart_and_gives_multipliers_of_all(equations: int) -> None:
    pytest.importorskip("qoco", reason="QOCO is not installed")
    program, fake, solver = (
        disk(np.random.default_rng(2), equations),
        FakeQoco("QOCO_SOLVED_INACCURATE"),
        Qoco(),
    )
    solver._qoco = SimpleNamespace(QOCO=lambda: fake)
    answer = solver.solve(program)
    assert (answer.status, answer.accurate) == ("QOCO_SOLVED_INACCURATE", False)
    assert answer.multipliers is not None
    assert list(answer.multipliers) == [2.0, 3.0, 4.0][1 - equations :]
    (n, m, p, _, q, a, b, g, h, count, cones, sizes), settings = fake.given["setup"]
    assert (n, m, p, count, cones, list(sizes)) == (3, 10, equations, 6, 1, [4])
    assert settings == {"abstol": interior_point.TOLERANCE, "reltol": interior_point.TOLERANCE}
    assert np.array_equal(q, program.cost)
    assert np.array_equal(h, program.bound[equations:])
    assert np.array_equal(g.toarray(), program.matrix.toarray()[equations:])
    solver.solve(program)
    assert fake.given["P"] is None
    assert np.array_equal(fake.given["c"], program.cost)
    assert np.array_equal(fake.given["h"], h)
    assert np.array_equal(fake.given["G"], g.data)
    if equations:
        assert np.array_equal(fake.given["A"], a.data)
        assert np.array_equal(fake.given["b"], b)
        assert np.array_equal(b, program.bound[:1])
    else:
        assert (a, b, fake.given["A"], fake.given["b"]) == (None,) * 4


# --- one that fails, and others behind it -------------------------------------------------------

Word = Answer | BaseException


class Scripted:
    """A solver that answers or raises, one after the other."""

    def __init__(self, words: list[Word]) -> None:
        self._words = words

    def solve(self, _: ConeProgram) -> Answer:
        word = self._words.pop(0)
        if isinstance(word, BaseException):
            raise word
        return word


def script(
    monkeypatch: pytest.MonkeyPatch, first: list[Word], second: list[Word]
) -> dict[str, int]:
    """Two solvers with what they say from now on; counts how often each was built."""
    built = {"CLARABEL": 0, "QOCO": 0}

    def maker(name: str, words: list[Word]) -> Callable[[], Scripted]:
        def make() -> Scripted:
            built[name] += 1
            return Scripted(words)

        return make

    monkeypatch.setitem(SOLVERS, "CLARABEL", maker("CLARABEL", first))
    monkeypatch.setitem(SOLVERS, "QOCO", maker("QOCO", second))
    return built


def said(status: str, *, accurate: bool) -> Answer:
    return Answer(np.ones(2), status, accurate, 1.0)


GOOD, POOR = said("good", accurate=True), said("poor", accurate=False)


def test_a_good_answer_asks_nobody_else(monkeypatch: pytest.MonkeyPatch) -> None:
    built = script(monkeypatch, [GOOD, GOOD], [])
    solver = Recovering("CLARABEL")
    for _ in range(2):
        assert solver.solve(FREE) == GOOD
    assert built == {"CLARABEL": 1, "QOCO": 0}


def test_seconds_of_all_that_answered_count(monkeypatch: pytest.MonkeyPatch) -> None:
    built = script(monkeypatch, [POOR, POOR], [GOOD])
    assert Recovering("CLARABEL").solve(FREE) == GOOD._replace(solver_s=3.0)
    assert built == {"CLARABEL": 2, "QOCO": 1}
    script(monkeypatch, [ValueError("no"), POOR], [GOOD])
    assert Recovering("CLARABEL").solve(FREE).solver_s == 2.0
    script(monkeypatch, [ValueError("no"), GOOD], [])
    assert Recovering("CLARABEL").solve(FREE).solver_s == 1.0


def test_the_one_named_is_asked_first_and_kept_when_built_again(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    built = script(monkeypatch, [], [POOR, GOOD, GOOD])
    solver = Recovering("QOCO")
    for _ in range(2):
        assert solver.solve(FREE).status == "good"
    assert built == {"CLARABEL": 0, "QOCO": 2}


def test_another_that_helped_out_is_not_kept(monkeypatch: pytest.MonkeyPatch) -> None:
    built = script(monkeypatch, [POOR, POOR, GOOD], [GOOD])
    solver = Recovering("CLARABEL")
    for _ in range(2):
        assert solver.solve(FREE).status == "good"
    assert built == {"CLARABEL": 2, "QOCO": 1}


def test_of_inaccurate_answers_the_first_is_taken(monkeypatch: pytest.MonkeyPatch) -> None:
    again, other = (said(name, accurate=False) for name in ("again", "other"))
    script(monkeypatch, [POOR, again], [other])
    assert Recovering("CLARABEL").solve(FREE) == POOR._replace(solver_s=3.0)
    script(monkeypatch, [POOR, ValueError("no")], [ValueError("no")])
    assert Recovering("CLARABEL").solve(FREE) == POOR
    script(monkeypatch, [ValueError("no"), ValueError("no")], [other])
    assert Recovering("CLARABEL").solve(FREE) == other


def test_another_that_is_not_installed_is_passed_over(monkeypatch: pytest.MonkeyPatch) -> None:
    script(monkeypatch, [POOR, POOR, ValueError("a"), ValueError("b")], [])

    def absent() -> Scripted:
        raise ModuleNotFoundError("no module named so")

    later = {"QOCO": absent, "third": lambda: Scripted([GOOD])}
    for name, make in later.items():
        monkeypatch.setitem(SOLVERS, name, make)
    assert Recovering("CLARABEL").solve(FREE).status == "good"
    monkeypatch.delitem(SOLVERS, "third")
    with pytest.raises(ValueError, match=r"^b$"):
        Recovering("CLARABEL").solve(FREE)


class Panic(BaseException):
    """What a panic in Rust is to Python."""


@pytest.mark.parametrize("error", [ValueError("x"), ZeroDivisionError("x"), Panic("x")])
def test_whatever_a_solver_raises_is_a_failure_to_answer(
    error: BaseException, monkeypatch: pytest.MonkeyPatch
) -> None:
    script(monkeypatch, [error, GOOD], [])
    assert Recovering("CLARABEL").solve(FREE).status == "good"
    script(monkeypatch, [error, error], [ValueError("y")])
    with pytest.raises(ValueError, match=r"^x; y$"):
        Recovering("CLARABEL").solve(FREE)


@pytest.mark.parametrize("error", [KeyboardInterrupt, MemoryError])
def test_what_is_no_fault_of_the_solver_goes_through(
    error: type[BaseException], monkeypatch: pytest.MonkeyPatch
) -> None:
    script(monkeypatch, [error(), GOOD], [GOOD])
    with pytest.raises(error):
        Recovering("CLARABEL").solve(FREE)


@pytest.mark.parametrize(("value", "taken"), [(0.9 * HUGE, True), (-HUGE, False), (np.nan, False)])
def test_numbers_have_to_be_finite(
    value: float, taken: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    script(monkeypatch, [GOOD._replace(x=np.array([0.0, value])), POOR], [POOR])
    assert Recovering("CLARABEL").solve(FREE).accurate is taken
    assert np.isfinite(value) or not taken
    odd = GOOD._replace(x=np.array([0.0, value]))
    script(monkeypatch, [odd, odd], [odd])
    if not taken:
        reason = "the conic solver gave no finite burns"
        with pytest.raises(ValueError, match=f"^{reason}; {reason}$"):
            Recovering("CLARABEL").solve(FREE)


def test_only_an_accurate_answer_with_multipliers_is_held_to_them(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    program, x, z = tent()
    right = Answer(x, "right", True, 1.0, z)
    off = right._replace(x=x + 0.1)
    script(monkeypatch, [right], [])
    assert Recovering("CLARABEL").solve(program) == right
    script(monkeypatch, [off._replace(multipliers=None)], [])
    assert Recovering("CLARABEL").solve(program).x is off.x
    script(monkeypatch, [off._replace(accurate=False)] * 2, [ValueError("no")])
    assert Recovering("CLARABEL").solve(program).x is off.x
    script(monkeypatch, [off] * 2, [off])
    doubt = "{} ended with status right and proves nothing by it"
    both = "; ".join(doubt.format(name) for name in ("CLARABEL", "QOCO"))
    with pytest.raises(ValueError, match=f"^{both}$"):
        Recovering("CLARABEL").solve(program)


def test_a_solver_that_is_not_installed_is_missed_at_once(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "qoco", None)
    with pytest.raises(ModuleNotFoundError, match="qoco"):
        Recovering("QOCO")
