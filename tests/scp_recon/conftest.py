"""The default mission, planned and verified once for all tests of this wing."""

from collections.abc import Iterator
from dataclasses import replace
from types import ModuleType

import pytest

from scp_recon.mission.mission import Mission
from scp_recon.monte_carlo import estimates
from scp_recon.planning import initial_guess
from scp_recon.planning.planner import Plan, plan
from scp_recon.results.solution import Solution, make_solution
from scp_recon.scenario.load import Scenario, load_scenario
from scp_recon.verification.reintegration import Verification, verify

from .support import CommandLine, fly_few, run_solve


@pytest.fixture(scope="session")
def scenario() -> Scenario:
    return load_scenario()


@pytest.fixture(scope="session")
def mission(scenario) -> Mission:
    return Mission.from_scenario(scenario)


@pytest.fixture(scope="session")
def default_plan(mission) -> Plan:
    """Cold start, condensed, facets from P3."""
    return plan(mission, initial_guess.cold(mission))


@pytest.fixture(scope="session")
def solution(default_plan) -> Solution:
    return make_solution(default_plan)


@pytest.fixture(scope="session")
def verification(mission, solution) -> Verification:
    return verify(mission, solution)


@pytest.fixture(scope="session")
def verified(solution, verification) -> Solution:
    return replace(solution, verification=verification)


@pytest.fixture(scope="session")
def default_run(tmp_path_factory) -> CommandLine:
    """`python -m scp_recon.solve --init cold`, once."""
    return run_solve(tmp_path_factory.mktemp("default"), "--init", "cold")


@pytest.fixture(scope="session")
def spice() -> ModuleType:
    """SPICE, with no kernel loaded; what needs it is skipped without it."""
    return pytest.importorskip("spiceypy")


@pytest.fixture
def few_flights(monkeypatch) -> None:
    """Of verifications within the test; those of what is made once have as many as ever."""
    fly_few(monkeypatch)


@pytest.fixture(scope="module")
def fewer() -> Iterator[None]:
    """A tenth of the flights that certify."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(estimates, "FLIGHTS_MIN", 1_000)
        patch.setattr(estimates, "FAILURES", 50)
        yield
