"""Threads of BLAS: one while the library works, and the user's number after it."""

from threading import Barrier, Thread

import numpy.linalg  # noqa: F401 -- its BLAS is one of those that are limited
import pytest
import scipy.linalg  # noqa: F401
from threadpoolctl import threadpool_info, threadpool_limits

import scp_recon as sr
from scp_recon.api import files, planning
from scp_recon.jobs.blas import GIVEN, OneThread, one_thread


@pytest.fixture
def two_threads(monkeypatch):
    for name in GIVEN:
        monkeypatch.delenv(name, raising=False)
    with threadpool_limits(limits=2, user_api="blas"):
        if numbers() != {2}:
            pytest.skip("BLAS has one thread here")
        yield


def numbers() -> set[int]:
    return {found["num_threads"] for found in threadpool_info() if found["user_api"] == "blas"}


@pytest.mark.usefixtures("two_threads")
def test_work_has_one_thread_and_restores_the_users(monkeypatch, solution):
    seen = []
    monkeypatch.setattr(files.reintegration, "verify", lambda *_: seen.append(numbers()))
    sr.verify(solution)
    monkeypatch.setattr(planning, "load", lambda _: seen.append(numbers()))
    with pytest.raises(TypeError):  # nothing was loaded
        sr.plan()
    assert seen == [{1}, {1}]
    assert numbers() == {2}


@pytest.mark.usefixtures("two_threads")
def test_threads_that_overlap_restore_once():
    """The first to enter leaves first: nested contexts would restore one thread for ever."""
    context, entered, left = OneThread(), Barrier(2, timeout=10), Barrier(2, timeout=10)

    def second() -> None:
        with context:
            entered.wait()
            left.wait()
            seen.append(numbers())

    seen: list[set[int]] = []
    other = Thread(target=second)
    with context:
        other.start()
        entered.wait()
    seen.append(numbers())
    left.wait()
    other.join()
    assert seen == [{1}, {1}]
    assert numbers() == {2}


@pytest.mark.usefixtures("two_threads")
def test_number_given_by_the_user_is_kept(monkeypatch):
    monkeypatch.setenv(GIVEN[0], "2")
    with one_thread:
        assert numbers() == {2}
