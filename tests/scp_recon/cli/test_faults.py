"""Faults around the planner: conic solvers, disks, the terminal, and being killed.

Usual runs take a few faults of each kind, ten of the conic solvers' in all; `nightly` takes every one.
"""

import errno
import io
import os
import signal
from collections.abc import Callable, Iterator
from contextlib import redirect_stdout
from dataclasses import replace
from functools import cache
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import clarabel
import numpy as np
import pytest

from formulations.program import solvers
from formulations.program.certificate import ConeProgram
from formulations.program.solvers import SOLVERS, Answer, Clarabel
from scp_recon import files
from scp_recon.api import flights, planning
from scp_recon.cli.commands import montecarlo, simulate, solve, verify
from scp_recon.mission.mission import Mission
from scp_recon.planning import initial_guess, planner
from scp_recon.planning.planner import Plan, plan
from scp_recon.results.read import read_solution
from scp_recon.scenario.load import load_scenario
from scp_recon.scp.status import Status
from scp_recon.verification import reintegration
from tests import reliability
from tests.helpers import usually
from tests.scenarios import COARSE
from tests.scp_recon.support import raising, run_solve


class PanicError(BaseException):
    """As a panic in Rust arrives in Python: no Exception."""


Fault = Callable[[ConeProgram, Answer], Answer]


def inaccurate(_: ConeProgram, answer: Answer) -> Answer:
    """Far from its tolerances, and it says so."""
    noise = np.random.default_rng(0).normal(scale=1e-3, size=answer.x.shape)
    return Answer(answer.x + noise, "AlmostSolved", False, answer.solver_s)


def not_finite(_: ConeProgram, answer: Answer) -> Answer:
    return answer._replace(x=np.full_like(answer.x, np.nan))


def huge(_: ConeProgram, answer: Answer) -> Answer:
    return answer._replace(x=np.full_like(answer.x, 1e300))


def nonsense(_: ConeProgram, answer: Answer) -> Answer:
    """Numbers of the right size that solve nothing, called solved."""
    return answer._replace(x=np.random.default_rng(1).permutation(answer.x))


FAULTS: dict[str, Fault] = {
    "panic": raising(PanicError("called `Option::unwrap()` on a `None` value")),
    "inaccurate": inaccurate,
    "nonsense": nonsense,
    "not finite": not_finite,
    "huge": huge,
    "error": raising(ValueError("the factorisation failed")),
    "foreign error": raising(RuntimeError("an assertion in the solver")),
    "arithmetic": raising(ZeroDivisionError("division by zero")),
}


class Faulty:
    """Clarabel, some of whose answers are spoilt."""

    def __init__(self, fault: Fault, spoilt: Callable[[], bool]) -> None:
        self._solver, self._fault, self._spoilt = Clarabel({}), fault, spoilt

    def solve(self, program: ConeProgram) -> Answer:
        answer = self._solver.solve(program)
        return self._fault(program, answer) if self._spoilt() else answer


@cache
def coarse() -> tuple[Mission, Plan]:
    mission = Mission.from_scenario(load_scenario(None, [COARSE]))
    return mission, plan(mission, initial_guess.cold(mission))


def assert_honest(found: Plan) -> None:
    """Nothing is called converged that is not the optimum, and nothing infeasible at all."""
    status, best = found.final.result.status, coarse()[1].final.result.lin.iterate.total_dv
    assert status is not Status.INFEASIBLE
    if status is Status.CONVERGED:
        assert found.final.result.lin.iterate.total_dv == pytest.approx(best, rel=2e-3)
        misses = found.final.merit.violations(found.final.result.lin).values()
        assert max(float(miss.max(initial=0.0)) for miss in misses) <= 1e-6
    assert np.isfinite(found.final.result.lin.iterate.mean).all()
    reliability.count(reliability.FAULTS)


GIVEN_UP = (Status.SOLVER_FAILED, Status.STALLED, Status.MAX_ITERATIONS)

ANOTHER = ["error", "panic", "not finite", "foreign error", "arithmetic"]


@pytest.mark.parametrize(
    ("name", "how"),
    [
        *usually([(name, "now and then") for name in FAULTS], 3),
        *usually([(name, "another is there") for name in ANOTHER], 1),
        *usually([(name, "always") for name in FAULTS], 1),
    ],
)
def test_a_solver_that_fails_is_asked_again_then_another_and_then_the_plan_ends_in_a_status(
    name, how, monkeypatch
):
    mission, _ = coarse()
    calls: Iterator[int] = iter(range(10_000))
    spoilt = (lambda: next(calls) % 3 == 1) if how == "now and then" else lambda: True
    monkeypatch.setitem(SOLVERS, "CLARABEL", lambda _: Faulty(FAULTS[name], spoilt))
    if how == "another is there":
        pytest.importorskip("qoco", reason="there is no other solver")
    else:
        monkeypatch.delitem(SOLVERS, "QOCO")
    found = plan(mission, initial_guess.cold(mission))
    expected = GIVEN_UP if how == "always" else (Status.CONVERGED,)
    assert found.final.result.status in expected
    assert_honest(found)


class Liar:
    """Clarabel, whose answers are not what it says they are."""

    def __init__(self, p: Any, q: Any, a: Any, b: Any, cones: Any, settings: Any) -> None:
        self._solver = clarabel.DefaultSolver(p, q, a, self.asked(b), cones, settings)

    def update(self, b: Any, **data: Any) -> None:
        self._solver.update(b=self.asked(b), **data)

    def asked(self, b: Any) -> Any:
        return b

    def solve(self) -> Any:
        return self.told(self._solver.solve())

    def told(self, found: Any) -> Any:
        return found


class Stale(Liar):
    """The first answer again and again."""

    first: Any = None

    def told(self, found: Any) -> Any:
        self.first = self.first or found
        return self.first


class Timid(Liar):
    """Feasible, and far from optimal: the best next to where it stands, called solved."""

    def asked(self, b: Any) -> Any:
        n = 3 * coarse()[0].problem.n_burns
        middle = 0.5 * (b[:n] - b[n : 2 * n])  # of the trust region's rows, radius +- burns
        assert np.ptp(b[:n] + b[n : 2 * n]) < 1e-9
        return np.concatenate([1e-7 + middle, 1e-7 - middle, b[2 * n :]])


class Mislabelled(Liar):
    def told(self, found: Any) -> Any:
        return SimpleNamespace(x=found.x, z=found.z, status="PrimalInfeasible", solve_time=0.0)


@pytest.mark.parametrize("liar", [Stale, Timid, Mislabelled])
def test_a_wrong_status_is_found_out(liar, monkeypatch):
    """A verdict needs a closed duality gap, whatever the solver calls its answer."""
    mission, _ = coarse()
    names = {name: getattr(clarabel, name) for name in dir(clarabel)}
    lying = SimpleNamespace(**{**names, "DefaultSolver": liar})
    monkeypatch.setattr(solvers, "clarabel", lying)
    monkeypatch.delitem(SOLVERS, "QOCO")
    found = plan(mission, initial_guess.cold(mission))
    # Asked again from nothing, one that repeats itself tells the truth.
    assert (found.final.result.status is Status.CONVERGED) == (liar is Stale)
    assert_honest(found)


@pytest.fixture
def instant(monkeypatch, default_plan, verification) -> None:
    """The planning and the verification of the default scenario, done already."""
    monkeypatch.setattr(planner, "plan", lambda *_, **__: default_plan)
    monkeypatch.setattr(planning, "verify", lambda *_: verification)


FULL = OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
BARRED = PermissionError(errno.EACCES, os.strerror(errno.EACCES))


@pytest.mark.usefixtures("instant")
@pytest.mark.parametrize("trouble", [FULL, BARRED])
@pytest.mark.parametrize(
    ("place", "name"),
    [(os, "fsync"), (Path, "replace"), (Path, "mkdir"), (files, "TemporaryFile")],
)
def test_a_disk_that_cannot_be_written_ends_with_a_message_and_the_old_file(
    place, name, trouble, tmp_path, solution, monkeypatch
):
    before = solution.write(tmp_path).read_bytes()
    monkeypatch.setattr(place, name, raising(trouble))
    run = run_solve(tmp_path)
    monkeypatch.undo()
    assert run.exit_code == 2
    assert run.errors.count("error: ") == 1
    assert "Traceback" not in run.errors
    assert [file.name for file in tmp_path.iterdir()] == ["solution.json"]
    assert (tmp_path / "solution.json").read_bytes() == before
    reliability.count(reliability.FAULTS)


@pytest.mark.parametrize(
    ("command", "name"),
    [(solve, "solution.json"), (montecarlo, "montecarlo.json"), (simulate, "simulation.npz")],
    ids=lambda given: getattr(given, "name", ""),
)
@pytest.mark.parametrize("fault", ["a folder in the file's place", "a barred folder"])
def test_a_target_that_cannot_be_written_is_found_out_before_the_work(
    command, name, fault, tmp_path, solution, monkeypatch, capsys
):
    solution.write(tmp_path)
    out = tmp_path / "out" if command is not montecarlo else tmp_path
    if fault == "a barred folder":
        monkeypatch.setattr(files, "TemporaryFile", raising(BARRED))
    else:
        (out / name).mkdir(parents=True)
    monkeypatch.setattr(planner, "plan", lambda: None)  # calling it so is a TypeError
    monkeypatch.setattr(flights, "fly_many", None)
    monkeypatch.setattr(flights.records, "make_record", None)
    given = [] if command is solve else [str(tmp_path)]
    assert command.main([*given, *([] if out == tmp_path else ["--out", str(out)])]) == 2
    assert capsys.readouterr().err.count("error: ") == 1
    reliability.count(reliability.FAULTS)


class FullDevice(io.BytesIO):
    """As /dev/full, but that it can be closed."""

    write = raising(FULL)


@pytest.mark.usefixtures("instant")
@pytest.mark.parametrize("command", ["solve", "verify", "montecarlo"])
def test_a_full_device_behind_the_terminal_ends_with_a_message(
    command, tmp_path, solution, monkeypatch, verification, capsys
):
    solution.write(tmp_path)
    monkeypatch.setattr(reintegration, "verify", lambda *_: verification)
    run = {
        "solve": lambda: solve.main(["--out", str(tmp_path)]),
        "verify": lambda: verify.main([str(tmp_path)]),
        "montecarlo": lambda: montecarlo.main([str(tmp_path), "--samples", "20"]),
    }[command]
    device = io.TextIOWrapper(FullDevice(), encoding="utf-8", line_buffering=True)
    with redirect_stdout(device):
        assert run() == 2
    assert capsys.readouterr().err.count("error: ") == 1
    assert read_solution(tmp_path).problem == "P2"
    reliability.count(reliability.FAULTS)


def test_running_out_of_memory_ends_with_a_message(tmp_path, monkeypatch):
    monkeypatch.setattr(planner, "plan", raising(MemoryError()))
    run = run_solve(tmp_path)
    assert run.exit_code == 2
    assert "memory" in run.errors
    reliability.count(reliability.FAULTS)


@pytest.mark.skipif(not hasattr(os, "fork"), reason="there is no SIGKILL here")
@pytest.mark.parametrize(("place", "name"), [(Path, "open"), (os, "fsync"), (Path, "replace")])
def test_killed_while_writing_the_file_is_the_old_one(place, name, tmp_path, solution):
    replace(solution, message="the old one").write(tmp_path)
    if (pid := os.fork()) == 0:
        setattr(place, name, lambda *_, **__: os.kill(os.getpid(), signal.SIGKILL))
        solution.write(tmp_path)
        os._exit(0)
    _, status = os.waitpid(pid, 0)
    assert os.WTERMSIG(status) == signal.SIGKILL
    assert read_solution(tmp_path).message == "the old one"
    reliability.count(reliability.FAULTS)
