"""Faults around the planner: disks, the terminal, memory, and being killed."""

import errno
import io
import os
import signal
from contextlib import redirect_stdout
from dataclasses import replace
from pathlib import Path

import pytest

from scp_recon import files
from scp_recon.api import flying as flights
from scp_recon.api import planning
from scp_recon.cli.commands import montecarlo, simulate, solve, verify
from scp_recon.planning import planner
from scp_recon.results.read import read_solution
from scp_recon.verification import reintegration
from tests import reliability
from tests.scp_recon.support import raising, run_solve

pytestmark = pytest.mark.slow


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
def test_unwritable_disk_leaves_old_file_and_one_message(
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
def test_unwritable_target_is_refused_before_the_work(
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
def test_full_output_device_ends_with_a_message(
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


def test_lack_of_memory_ends_with_a_message(tmp_path, monkeypatch):
    monkeypatch.setattr(planner, "plan", raising(MemoryError()))
    run = run_solve(tmp_path)
    assert run.exit_code == 2
    assert "memory" in run.errors
    reliability.count(reliability.FAULTS)


@pytest.mark.skipif(not hasattr(os, "fork"), reason="there is no SIGKILL here")
@pytest.mark.parametrize(("place", "name"), [(Path, "open"), (os, "fsync"), (Path, "replace")])
def test_kill_while_writing_leaves_the_old_file(place, name, tmp_path, solution):
    replace(solution, message="the old one").write(tmp_path)
    if (pid := os.fork()) == 0:
        setattr(place, name, lambda *_, **__: os.kill(os.getpid(), signal.SIGKILL))
        solution.write(tmp_path)
        os._exit(0)
    _, status = os.waitpid(pid, 0)
    assert os.WTERMSIG(status) == signal.SIGKILL
    assert read_solution(tmp_path).message == "the old one"
    reliability.count(reliability.FAULTS)
