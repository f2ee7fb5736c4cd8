"""Jobs in this process and on processes of this machine: the same rows, and nothing left behind."""

import os
import signal
import time
from collections.abc import Iterator
from contextlib import closing
from pathlib import Path

import pytest

from scp_recon.errors import InputError
from scp_recon.jobs.job import Job, here, in_order
from scp_recon.jobs.processes import Limits, Processes
from scp_recon.jobs.store import Store, run
from tests.scp_recon.jobs.support import LIMITS, backwards, children, computed, run_all, some_jobs
from tests.scp_recon.jobs.works import ENDS, Naughty, OddError, Quick


@pytest.mark.slow
@pytest.mark.parametrize("executor", [here, Processes(1, LIMITS), Processes(3), backwards])
def test_rows_are_the_same_for_any_split(executor, tmp_path):
    jobs = some_jobs(40)
    rows = run_all(Quick(), jobs, tmp_path / "a", executor)
    assert computed(rows) == computed(run_all(Quick(), jobs, tmp_path / "b"))
    found = list(in_order(executor, Quick(), iter(jobs)))
    assert [done.key for done in found] == list(range(40))
    assert [done.result() for done in found] == [Quick()(number) for number in range(40)]


@pytest.mark.slow
def test_misbehaving_jobs_do_not_change_other_rows(tmp_path):
    jobs, ways = some_jobs(18), dict(zip(range(1, 17, 2), ENDS, strict=True))
    naughty = Naughty(ways=tuple(ways.items()))
    found = run_all(naughty, jobs, tmp_path / "a", Processes(2, LIMITS))
    assert {n: found[n]["status"] for n in ways} == {n: ENDS[way] for n, way in ways.items()}
    assert {way: found[n]["tries"] for n, way in ways.items()} == dict.fromkeys(ENDS, 1) | {
        "die": 3,
        "eat": found[5]["tries"],
    }
    assert found[1]["message"] == "took longer than 6 s"
    assert found[3]["message"] == "took longer than 0.5 s of the processor"
    assert found[11]["message"] == "ZeroDivisionError: in\nthe job"
    assert found[13]["message"] == "OddError: 1 and 2"
    raising = {n: way for n, way in ways.items() if way.startswith(("raise", "refuse", "end"))}
    own = run_all(Naughty(ways=tuple(raising.items())), jobs, tmp_path / "here")
    assert computed({n: own[n] for n in raising}) == computed({n: found[n] for n in raising})
    serial = run_all(Quick(), jobs, tmp_path / "b")
    assert all(found[n]["value"] == serial[n]["value"] for n in range(18) if n not in ways)


@pytest.mark.parametrize("executor", [here, Processes(1, LIMITS)])
def test_a_result_raises_what_the_work_raised(executor, tmp_path):
    work = Naughty(ways=((0, "raise"), (1, "refuse")))
    first, second = in_order(executor, work, some_jobs(2))
    with pytest.raises(ZeroDivisionError, match="in\nthe job"):
        first.result()
    with pytest.raises(InputError) as caught:
        second.result()
    assert (caught.value.entry, caught.value.given) == ("x", "0")
    with (
        Store(tmp_path / "rows.jsonl", {}) as store,
        pytest.raises(ZeroDivisionError, match="in\nthe job"),
    ):
        run(work, some_jobs(2), store, executor)


@pytest.mark.slow
def test_what_does_not_pickle_is_a_message():
    odd, dead, whole = in_order(
        Processes(1, LIMITS), Naughty(ways=((0, "raise oddly"), (1, "die"))), some_jobs(3)
    )
    with pytest.raises(InputError, match="OddError: 1 and 2"):
        odd.result()
    with pytest.raises(InputError, match="got block 1, died"):
        dead.result("flights", "block")
    assert whole.result() == Quick()(2)
    with pytest.raises(OddError):
        next(here(Naughty(ways=((0, "raise oddly"),)), some_jobs(1))).result()
    (lost,) = Processes(1, LIMITS)(unpicklable, some_jobs(1))
    assert "pickle" in lost.failure.message


def unpicklable(_: int) -> object:
    return lambda: None


def test_early_close_leaves_no_process():
    """Who stops early, as flights do whose interval is narrow, has not had a million jobs made."""
    taken, before = [], set(children())

    def many() -> Iterator[Job]:
        for number in range(10**6):
            taken.append(number)
            yield Job(number, number)

    with closing(Processes(2, LIMITS)(Quick(), many())) as ended:
        first = [next(ended).key for _ in range(5)]
    assert len(set(first)) == 5
    assert len(taken) < 40
    assert set(children()) <= before


def test_a_process_ends_with_who_began_it():
    """Killed, a parent cannot end its processes: they see to it."""
    pid = os.fork()
    if pid == 0:  # begins one that would sleep, and is killed
        try:
            list(Processes(1, Limits(60.0))(Quick(30.0), some_jobs(1)))
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


def test_work_that_cannot_be_loaded_is_one_message(tmp_path):
    with pytest.raises(InputError, match="AttributeError"):
        run_all(Vanishing(), some_jobs(3), tmp_path, Processes(1, LIMITS))


class Vanishing(Quick):
    """Cannot be made again elsewhere."""

    def __reduce__(self) -> tuple[object, ...]:
        return getattr, ("", "no_such_name")


def is_there(pid: int) -> bool:
    try:
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] != "Z"
    except OSError:
        return False
