"""Work divided among cores: the same results, wherever and however it is done."""

from __future__ import annotations

import os
import signal
import time

import pytest

from scp_recon.jobs import cores
from tests.scp_recon.jobs.support import children


@pytest.fixture(params=[1, 2, 3])
def number(request, monkeypatch):
    monkeypatch.setattr(cores, "cores", lambda: request.param)
    before = set(children())
    yield request.param
    assert set(children()) <= before


@pytest.mark.parametrize("count", [0, 1, 2, 7])
def test_results_keep_the_order_of_items(number, count):
    told = []
    found = cores.each(lambda item: (item**2, os.getpid()), range(count), told.append)
    assert [square for square, _ in found] == [item**2 for item in range(count)]
    assert len({process for _, process in found}) == min(number, count)
    assert told[-1:] == [count][: bool(count)]


@pytest.mark.usefixtures("number")
def test_exception_of_the_work_ends_other_processes():
    def work(item):
        if item:
            raise ZeroDivisionError(item)
        return item

    with pytest.raises(ZeroDivisionError, match="1"):
        cores.each(work, range(2))
    begun = time.perf_counter()
    with pytest.raises(KeyboardInterrupt), cores.beside(lambda: time.sleep(60.0)):
        raise KeyboardInterrupt
    assert time.perf_counter() - begun < 30.0


@pytest.mark.usefixtures("number")
def test_work_of_a_dead_copy_is_done_here(monkeypatch):
    here = os.getpid()

    def work():
        if os.getpid() != here:
            os.kill(os.getpid(), signal.SIGKILL)
        return "done"

    with cores.beside(work) as result:
        assert result() == "done"
    monkeypatch.setattr(os, "fork", lambda: (_ for _ in ()).throw(BlockingIOError))
    with cores.beside(work) as result:
        assert result() == "done"


def test_cores_are_limited_by_the_environment(monkeypatch):
    """Threads that another test left, Dask's say, are none of this process's own."""
    monkeypatch.setattr(cores.threading, "active_count", lambda: 1)
    monkeypatch.setenv(cores.CORES, "1")
    assert cores.cores() == 1
    for said in ("", "0", "many"):
        monkeypatch.setenv(cores.CORES, said)
        assert cores.cores() == len(os.sched_getaffinity(0))
