"""How a verdict is told: shortfalls of flights, and their causes."""

from dataclasses import replace

import pytest

from formulations.rows.exact_flight import FLIGHT
from scp_recon.certification.flights import certificate_of
from scp_recon.interop.export import Export
from scp_recon.mission.mission import Mission
from scp_recon.monte_carlo.estimates import proportion, successes_needed
from scp_recon.monte_carlo.whole_flight import KeptCounts
from scp_recon.results.comparison import compare
from scp_recon.results.facts import EventProbability, Risk
from scp_recon.results.figures import FINAL_SIGMAS
from scp_recon.results.solution import HASH, Solution
from scp_recon.results.verification import BurnLimit, JointProbability, Verification
from scp_recon.scp.status import Status
from scp_recon.verification.causes import (
    UNTRIED,
    Cause,
    causes,
    kind_of,
    needed_step_s,
    next_lines,
)
from scp_recon.verification.probabilities import refuted
from tests.scp_recon.support import mission_of

ASKED, SAMPLES = 0.9, 10_000


@pytest.fixture(scope="module")
def exact() -> Mission:
    return mission_of("risk.allocation=exact", "risk.scope=flight", f"risk.p_chance={ASKED}")


def flown(successes: int) -> JointProbability:
    """What the verification's own flights reach."""
    value, low, high = proportion(successes, SAMPLES)
    return JointProbability(name=FLIGHT, worst_t_s=0.0, estimate=value, low=low, high=high)


def promising(
    solution: Solution, *, certified: int | None, by_law: float | None = None
) -> Solution:
    """A plan whose certificate has so many successes, or none; told by the law as asked."""
    reached = None
    if certified is not None:
        reached = certificate_of(KeptCounts(certified, certified, SAMPLES), 1, 1)
    law = EventProbability(name=FLIGHT, t_s=[0.0], probability=[by_law or ASKED], sigma=[0.0])
    risk = Risk(scope="flight", required=ASKED, target=ASKED, certificate=reached, normal_law=[law])
    return replace(solution, risk=risk)


ENOUGH = successes_needed(ASKED, SAMPLES)
"""Successes whose lower limit is what was asked."""


@pytest.mark.parametrize(
    ("certified", "by_law", "successes", "named"),
    [
        (ENOUGH, None, ENOUGH, []),
        # Though its estimate is more than what was asked, and other flights refute nothing.
        (ENOUGH - 1, None, ENOUGH - 1, ["certificate"]),
        (None, None, 8_900, [f"P({FLIGHT})"]),
        (ENOUGH, None, 8_900, [f"P({FLIGHT})"]),
        # Half of the flights of a plan that spends what was asked reach a little less.
        (None, None, 8_960, []),
        (None, 0.99, 9_100, ["risk"]),
    ],
)
def test_refuted_uncertified_probability_is_named(
    exact, solution, certified, by_law, successes, named
):
    told = replace(solution, scenario=exact.scenario)
    told = promising(told, certified=certified, by_law=by_law)
    assert refuted(told.mission, told, [flown(successes)]) == named


def test_low_estimate_fails_plan_of_uniform_risk(solution):
    told = replace(solution, scenario=mission_of(f"risk.p_chance={ASKED}").scenario)
    assert refuted(told.mission, told, [flown(8_999)]) == [f"P({FLIGHT})"]
    assert refuted(told.mission, told, [flown(9_000)]) == []


def failing(verification: Verification, *names: str, **figures: float) -> Verification:
    return replace(verification, **figures, failed=list(names), ok=False)  # type: ignore[arg-type]


def test_every_check_has_a_cause(mission, verification):
    """By its kind; a probability or a margin by where it is missed."""
    v = verification
    between = replace(v.mean_margins[-1], worst_t_s=float(mission.times_s[:2].mean()))
    v = replace(v, mean_margins=[*v.mean_margins[:-1], between])
    v = replace(v, burn_limits=(BurnLimit(2, "dv_max", 8000.0, 0.5),))
    at_nodes = [p for p in v.probabilities if min(abs(mission.times_s - p.worst_t_s)) < 1.0]
    found = {
        Cause.STATUS: {"status"},
        Cause.CERTIFICATE: {"certificate"},
        Cause.GRID: {
            "covariance_error",
            "max_defect",
            "sample_error_m",
            "terminal_position_error_m",
        },
        Cause.BETWEEN: {between.name},
        Cause.SHORT: {f"P({p.name})" for p in at_nodes},
        Cause.BURNS: {"dv_max"},
        Cause.SPREAD: {name for name, _, _ in FINAL_SIGMAS},
        Cause.COMMANDS: {"P(dv_max of burn 2)"},
        Cause.UNEXECUTED: {"dv_min of burn 2"},
        Cause.DRIFT: {"P(safe drift where burn 2 is missed)"},
        Cause.CONTRADICTION: {HASH, "facets", "violation", "nodes.t_s", "risk", "total_dv_m_s"},
    }
    assert found.keys() | {Cause.BY_LAW} == {*Cause}
    exact = mission.changed({"risk.allocation": "exact"})
    assert {kind_of(name, exact, v) for name in found[Cause.SHORT]} == {Cause.BY_LAW}
    for kind, names in found.items():
        assert names
        assert {kind_of(name, mission, v) for name in names} == {kind}


def test_it_says_how_fine_a_grid_is_enough(mission, verification):
    """At fourth order: half the limit of covariances that err by 17 times it at 232 s."""
    failed = failing(verification, "covariance_error", covariance_error=1.7e-5)
    assert causes(mission, failed) == (f"covariance, re-integrated: {Cause.GRID.value}",)
    assert needed_step_s(mission, failed) == 94.0
    edited = failing(verification, "covariance_error", covariance_error=0.5)
    assert causes(mission, edited) == (f"covariance, re-integrated: {Cause.CONTRADICTION.value}",)


def test_causes_without_advice_propose_nothing(mission, solution, verification):
    stalled = replace(solution, status=Status.STALLED.value.name)
    failed = failing(verification, "status", "P(emission)", "emission_max")
    line = f"status, P(emission), emission_max: {Cause.STATUS.value}"
    assert next_lines(mission, stalled, failed) == (line, UNTRIED)
    advised = replace(stalled, advice=("what was tried",))
    assert next_lines(mission, advised, failed) == ("what was tried",)
    assert next_lines(mission, solution, verification) == ()


def test_failed_checks_are_in_words_everywhere(solution, verification):
    failed = failing(verification, "risk", "covariance_error")
    words = "stored probabilities, covariance, re-integrated"
    assert str(failed).startswith(f"not verified: {words}\n")
    told = replace(solution, verification=failed)
    export = Export.of(told)
    assert export.shortfalls == [f"converged; failed: {words}"]
    assert f"no: {words}" in str(compare(["one", "two"], [solution, told]))
