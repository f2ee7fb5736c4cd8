"""Threads of BLAS: one while the library works, and the user's number after it.

In a process of its own, in which no variable limits the threads.
"""

import os

import pytest

from scp_recon.jobs.cores import GIVEN
from tests.scp_recon.support import run_python

SCRIPT = """
import os
import numpy.linalg, scipy.linalg
from threadpoolctl import threadpool_info, threadpool_limits
from scp_recon.jobs.cores import OneThread, one_thread
threads = lambda: {i["num_threads"] for i in threadpool_info() if "scipy_openblas" in i["prefix"]}
threadpool_limits(limits=2, user_api="blas")
assert threads() == {2}, threads()

# The library's verbs.
from scp_recon.api import planning
seen = []
def load(request):
    seen.append(threads())
    raise KeyboardInterrupt
planning.load = load
import scp_recon as sr
try:
    sr.plan()
except KeyboardInterrupt:
    assert seen == [{1}], seen
assert threads() == {2}, threads()

# Problems by hand, and the spacecraft.
import sys
from types import SimpleNamespace
from scp_recon.api import flying
from scp_recon.impulsive import plan, problem
seen = []
def watched(*given, **known):
    seen.append(threads())
    raise KeyboardInterrupt
plan.whole_number = problem.scp_method = problem.certified = watched
exact = SimpleNamespace(
    is_deterministic=False, risk=SimpleNamespace(allocation="exact"), probability=0.9, solve=watched
)
basilisk = SimpleNamespace(simulation=SimpleNamespace(simulate=watched))
sys.modules["scp_recon.simulation.basilisk"] = basilisk
simulation = flying.Simulation(SimpleNamespace(solution=None), 0, None, None)
for work in (
    lambda: plan.ImpulsivePlan.fly(None),
    lambda: problem.ImpulsiveProblem.solve(exact),
    lambda: problem.ImpulsiveProblem.certify(exact),
    simulation.fly,
):
    try:
        work()
    except KeyboardInterrupt:
        pass
    assert threads() == {2}, threads()
assert seen == 4 * [{1}], seen

# Two threads at once: the last one out restores the number.
from threading import Barrier, Thread
context, entered, left = OneThread(), Barrier(2, timeout=10), Barrier(2, timeout=10)
def second():
    with context:
        entered.wait()
        left.wait()
        assert threads() == {1}, threads()
other = Thread(target=second)
with context:
    other.start()
    entered.wait()
assert threads() == {1}, threads()
left.wait()
other.join()
assert threads() == {2}, threads()

# A number that the user gave is kept.
os.environ["OMP_NUM_THREADS"] = "2"
with one_thread:
    assert threads() == {2}, threads()
"""


@pytest.mark.slow
@pytest.mark.skipif((os.cpu_count() or 1) < 2, reason="needs two cores")
def test_one_thread_while_the_library_works():
    free = {name: value for name, value in os.environ.items() if name not in GIVEN}
    run = run_python("-c", SCRIPT, env=free)
    assert (run.returncode, run.stderr) == (0, "")
