"""A certified plan's promise is what flights reach that planning has not seen."""

import json
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import pytest
from scipy.special import ndtr, ndtri

from formulations.risk.strata import Allocation, Counted
from formulations.rows.exact_flight import FLIGHT
from scp_recon.certification import flights
from scp_recon.certification.certify import ROUNDS_MAX, certify
from scp_recon.certification.flights import (
    TEST_WIDTH,
    Step,
    certificate_of,
    unlike_beyond,
)
from scp_recon.monte_carlo.estimates import (
    CONFIDENCE,
    FIRST_SEED,
    FIRST_TEST_SEED,
    TEST_CONFIDENCE,
    TESTS_MAX,
    flights_of_test,
    proportion,
    seed_of_test,
)
from scp_recon.monte_carlo.whole_flight import KeptCounts
from scp_recon.planning import initial_guess
from scp_recon.planning.plan import Plan
from scp_recon.planning.planner import plan
from scp_recon.results.read import parse_solution
from scp_recon.results.solution import Solution, make_solution
from scp_recon.results.verification import JointProbability, Verification
from scp_recon.scp.status import Status
from scp_recon.verification.consistency import inconsistencies
from scp_recon.verification.probabilities import refuted
from scp_recon.verification.reintegration import verify
from tests.helpers import usually
from tests.scp_recon.certification.support import mission_of

pytestmark = [pytest.mark.usefixtures("fewer"), pytest.mark.slow]

ASKED = 0.9


@dataclass(frozen=True)
class Certified:
    """A plan, and the seeds of all flights that were flown to find it, in their order."""

    plan: Plan
    seeds: list[int]


@pytest.fixture(scope="module", params=usually(["flight", "strata", "node strata", "node"], 3))
def run(request) -> Certified:
    """Of plain flights with each scope, and of flights in strata."""
    scope = "node" if "node" in request.param else "flight"
    sampling = "strata" if "strata" in request.param else "plain"
    mission, seeds = mission_of(scope, ASKED, sampling), []

    def noting(fly: Callable[..., Any]) -> Callable[..., Any]:
        """The flights of a function, whose seed is that of its first argument, or of its flights."""

        def flown(of: Any, *given: Any) -> Any:
            seeds.append(getattr(of, "flights", of).seed)
            return fly(of, *given)

        return flown

    with pytest.MonkeyPatch.context() as patch:
        for name in ("kept_flights", "fly_strata"):
            patch.setattr(flights, name, noting(getattr(flights, name)))
        found = certify(
            mission, initial_guess.cold(mission), lambda m, s, target: plan(m, s, target=target)
        )
    return Certified(found, seeds)


@pytest.fixture(scope="module")
def certified(run) -> Plan:
    return run.plan


def test_the_lower_limit_is_what_was_asked(certified):
    reached = certified.certificate
    assert reached.low >= ASKED
    assert certified.target > ASKED
    if reached.strata is None:
        assert reached.samples == flights_of_test(ASKED)
    else:
        step = Step("", flights_of_test(ASKED), reached.seed, TEST_WIDTH, TEST_CONFIDENCE)
        kept = flights.fly_plan(None, certified, step)
        assert certificate_of(kept, reached.tests, reached.rounds) == reached
        assert reached.samples == sum(reached.strata.flown) < flights_of_test(ASKED)
        assert "draws of test" in str(reached)


@pytest.mark.parametrize("run", ["strata"], indirect=True)
def test_surprises_of_earlier_flights_are_looked_for(certified):
    """Where flights that the law is sure of have failed, the next test flies more of them."""
    allocation = Allocation(1e4, 5.0, (0.1, 0.5, 0.6, 0.6, 0.5, 0.1), (0.09, 0.1))
    counted = [
        Counted(allocation, (9, 0, 0, 0, 0, 9_000), (5, 0, 0, 0, 0, 1_000), (1, *(0,) * 4, 2))
    ]
    assert unlike_beyond([]) == (0.0, 0.0)
    assert unlike_beyond(counted * 2) == (0.2, 0.002)
    step = Step("", flights_of_test(ASKED), 7, TEST_WIDTH, TEST_CONFIDENCE)
    plain, wary = (
        flights.fly_plan(None, certified, replaced).strata.allocation.share[-1]
        for replaced in (step, step._replace(unlike=(0.2, 0.005)))
    )
    assert wary > 1.02 * plain


def test_rounding_keeps_nodes_at_least_as_likely():
    """In strata flights are as many plain ones as they are worth: a share of them is a quotient."""
    allocation = Allocation(1e4, 5.0, (0.1, 0.5, 0.6, 0.6, 0.5, 0.1), (0.09, 0.1))
    for failing in range(60):
        drawn = (failing, 0, 0, 0, 0, 9_000)
        counted = Counted(allocation, drawn, (0,) * 6, (0,) * 6)
        kept = (1.0 - counted.failed) * counted.equivalent
        told = certificate_of(KeptCounts(kept, kept, counted.equivalent, strata=counted), 1, 1)
        assert told.reached <= told.at_nodes == pytest.approx(told.reached)


def test_what_judges_no_round_has_flown(run):
    """Rounds come first, then at most two tests; a seed is flown once."""
    reached = run.plan.certificate
    rounds, tests = run.seeds[: reached.rounds], run.seeds[reached.rounds :]
    assert rounds == list(range(FIRST_SEED, FIRST_SEED + reached.rounds))
    assert tests == [seed_of_test(number + 1) for number in range(reached.tests)]
    assert tests[-1] == reached.seed
    assert len(rounds) <= ROUNDS_MAX
    assert len(tests) <= TESTS_MAX
    assert set(rounds).isdisjoint(tests)


@pytest.fixture(scope="module")
def solution(certified) -> Solution:
    return make_solution(certified)


@pytest.fixture(scope="module")
def checked(certified, solution) -> Verification:
    return verify(certified.mission, solution)


def failures(certified: Plan, told: Solution, checked: Verification) -> list[str]:
    """What verification names, with the flights that it has flown already."""
    mission = certified.mission
    return inconsistencies(mission, told) + refuted(mission, told, checked.probabilities)


def stating(solution: Solution, **changes: Any) -> Solution:
    return replace(solution, risk=replace(solution.risk, **changes))


def claiming(solution: Solution, **changes: Any) -> Solution:
    """With another certificate, whose interval is that of its flights unless it is changed."""
    told = replace(solution.risk.certificate, **changes)
    if told.strata is None:
        reached, low, high = proportion(
            round(told.reached * told.samples), told.samples, told.confidence
        )
        of_flights = {"reached": reached, "low": low, "high": high}
        of_flights["at_nodes"] = max(told.at_nodes, reached)
        told = replace(told, **(of_flights | changes))
    return stating(solution, certificate=told)


def test_certified_solution_is_verified(certified, solution, checked):
    assert (solution.risk.required, solution.risk.target) == (ASKED, certified.target)
    assert checked.ok, checked.failed
    names = {p.name for p in checked.probabilities}
    assert (FLIGHT in names) == (solution.risk.scope == "flight")
    assert failures(certified, claiming(solution), checked) == []


@pytest.mark.parametrize("run", ["flight"], indirect=True)
@pytest.mark.parametrize(
    ("changes", "name"),
    [
        ({"low": 0.95}, "risk"),
        ({"at_nodes": 0.5}, "risk"),
        ({"samples": 1_000}, "risk"),
        ({"seed": FIRST_SEED}, "risk"),
        ({"seed": FIRST_TEST_SEED + TESTS_MAX}, "risk"),
        ({"tests": TESTS_MAX + 1, "seed": seed_of_test(TESTS_MAX + 1)}, "risk"),
        ({"confidence": CONFIDENCE}, "risk"),
        ({"reached": 0.98}, "certificate"),
        ({"reached": 0.85}, "certificate"),
    ],
    ids=lambda value: str(value),
)
def test_false_certificate_is_named(certified, solution, checked, changes, name):
    assert name in failures(certified, claiming(solution, **changes), checked)


@pytest.mark.parametrize("run", ["strata"], indirect=True)
def test_false_strata_are_named(certified, solution, checked, tmp_path):
    """Fewer flights unlike the law would have reached more, and fewer draws are not enough."""
    strata = certified.certificate.strata
    fewer = replace(strata.allocation, draws=0.01 * strata.allocation.draws)
    for lie in (
        {"strata": replace(strata, unlike=(0,) * 6)},
        {"strata": replace(strata, allocation=fewer)},
        {"strata": None},
        {"samples": certified.certificate.samples + 1},
    ):
        told = stating(solution, certificate=replace(certified.certificate, **lie))
        assert "risk" in failures(certified, told, checked)
    read = parse_solution(json.loads(solution.write(tmp_path).read_text("utf-8")), "own")
    assert read.risk == solution.risk


def test_uncertified_plan_must_target_the_requirement(certified, solution, checked):
    """The plan of a lower probability does not pass for one of a higher, nor has it converged."""
    told = stating(solution, certificate=None)
    assert failures(certified, told, checked) == []
    asked = solution.risk.target + 1e-6
    higher = certified.mission.scenario.replace({"risk.p_chance": asked})
    told = replace(stating(told, required=asked), scenario=higher)
    assert inconsistencies(replace(certified.mission, scenario=higher), told) == ["risk"]
    missed = stating(solution, target=float(ndtr(ndtri(solution.risk.target) + 0.01)))
    assert failures(certified, missed, checked) == ["violation"]


@pytest.mark.parametrize("off", [0.006, -0.006])
def test_wrong_node_probability_is_named(certified, solution, checked, off):
    """By no more than 0.006 of about 0.91: of a flight it is its flights that have to tell."""
    law = solution.risk.normal_law
    least = min(law, key=lambda event: min(event.probability))
    at = int(np.argmin(least.probability))
    changed = [p + off * (k == at) for k, p in enumerate(least.probability)]
    lie = replace(least, probability=changed, sigma=ndtri(changed).tolist())
    told = stating(solution, normal_law=[lie if event is least else event for event in law])
    found = failures(certified, replace(told, carried=solution.figures), checked)
    assert "constraints" in found
    assert ("risk" in found) == (solution.risk.scope == "node")


@pytest.mark.parametrize("run", ["flight"], indirect=True)
@pytest.mark.parametrize("told", [0.96, 0.84])
def test_a_flight_law_that_flights_contradict_is_named(certified, solution, checked, told):
    """Of a plan that nothing certifies: 0.3 standard deviations off."""
    law = [replace(solution.risk.normal_law[0], probability=[told], sigma=[float(ndtri(told))])]
    lie = stating(solution, normal_law=law, certificate=None)
    assert "risk" in failures(certified, lie, checked)


@pytest.mark.parametrize("run", ["flight"], indirect=True)
def test_law_of_nodes_contradicts_no_whole_flights(certified, solution):
    """An infeasible plan of whole flights ends with the law of its nodes; a converged one does not."""
    nodes = [replace(solution.risk.normal_law[0], name="emission")]
    told = stating(solution, normal_law=nodes, certificate=None)
    flown = [JointProbability(name=FLIGHT, worst_t_s=0.0, estimate=0.5, low=0.49, high=0.51)]
    ended = replace(told, status=Status.INFEASIBLE.value.name)
    assert refuted(certified.mission, ended, flown) == [f"P({FLIGHT})"]
    assert refuted(certified.mission, told, flown) == [f"P({FLIGHT})", "risk"]
