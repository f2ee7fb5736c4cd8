"""Cases on processes of this machine: same rows as here, and nothing left behind."""

from __future__ import annotations

import os
import signal
import time
from collections.abc import Iterator
from contextlib import closing
from pathlib import Path

import pytest

from scp_recon.campaign.rows.case import Case
from scp_recon.campaign.rows.table import read_results
from scp_recon.campaign.runners.child import Limits
from scp_recon.campaign.runners.here import here
from scp_recon.campaign.runners.processes import Processes
from scp_recon.errors import InputError
from tests.scp_recon.campaign.support import LIMITS, run, some_cases
from tests.scp_recon.campaign.works import ENDS, Naughty, Quick


@pytest.mark.parametrize("workers", [1, 3])
def test_processes_give_the_serial_table(workers: int, tmp_path: Path) -> None:
    cases = some_cases(40)
    table = run(Quick(), cases, tmp_path / "a", Processes(workers, LIMITS))
    assert table.equals(run(Quick(), cases, tmp_path / "b", here))


def test_cases_that_misbehave_are_rows_and_the_others_are_as_ever(tmp_path: Path) -> None:
    cases, ways = some_cases(14), dict(zip((1, 3, 5, 7, 9, 11), ENDS, strict=True))
    run(Naughty(ways=tuple(ways.items())), cases, tmp_path / "a", Processes(2, LIMITS))
    run(Quick(), cases, tmp_path / "b", here)
    found, serial = (read_results(tmp_path / name).set_index("case") for name in "ab")
    assert {n: found.status[n] for n in ways} == {n: ENDS[way] for n, way in ways.items()}
    assert found.tries[5] == 3
    assert found.message[9] == "ZeroDivisionError: in\nthe case"
    for column in ("value", "seed", "x"):
        assert found[column].drop(list(ways)).equals(serial[column].drop(list(ways)))


def test_what_raises_is_the_same_row_here(tmp_path: Path) -> None:
    ways = tuple((n, way) for n, way in enumerate(ENDS) if way in ("end", "raise", "refuse"))
    tables = [
        run(Naughty(ways=ways), some_cases(6), tmp_path / name, runner)
        for name, runner in (("a", Processes(1, LIMITS)), ("b", here))
    ]
    assert tables[0].equals(tables[1])


def test_cases_are_taken_as_they_are_needed_and_an_early_end_leaves_no_process() -> None:
    """Who stops early, as flights do whose interval is narrow, has not had a million cases made."""
    taken, before = [], set(children())

    def many() -> Iterator[Case]:
        for number in range(10**6):
            taken.append(number)
            yield Case(number, number, {"x": 1.0})

    with closing(Processes(2, LIMITS)(Quick(), many())) as over:
        first = [next(over).case.number for _ in range(5)]
    assert len(set(first)) == 5
    assert len(taken) < 40
    assert set(children()) <= before


def test_a_process_ends_with_who_began_it() -> None:
    """Killed, a parent cannot end its processes: they see to it."""
    pid = os.fork()
    if pid == 0:  # begins one that would sleep, and is killed
        try:
            list(Processes(1, Limits(60.0, 256))(Quick(30.0), some_cases(1)))
        finally:
            os._exit(0)
    until = time.monotonic() + 60
    while not (found := children(pid)) and time.monotonic() < until:
        time.sleep(0.05)
    assert found
    os.kill(pid, signal.SIGKILL)
    os.waitpid(pid, 0)
    while is_there(found[0]) and time.monotonic() < until:
        time.sleep(0.1)
    assert not is_there(found[0])


def test_work_that_cannot_be_loaded_ends_the_campaign(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="AttributeError"):
        run(Vanishing(), some_cases(3), tmp_path, Processes(1, LIMITS))


class Vanishing(Quick):
    """Cannot be made again elsewhere."""

    def __reduce__(self) -> tuple[object, ...]:
        return getattr, ("", "no_such_name")


def children(of: int | None = None) -> list[int]:
    """Processes that a process has begun, by the system's list."""
    pid, found = of or os.getpid(), []
    for stat in Path("/proc").glob("[0-9]*/stat"):
        try:
            fields = stat.read_text().rpartition(")")[2].split()
        except OSError:
            continue
        if int(fields[1]) == pid and fields[0] != "Z":
            found.append(int(stat.parent.name))
    return found


def is_there(pid: int) -> bool:
    try:
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] != "Z"
    except OSError:
        return False
