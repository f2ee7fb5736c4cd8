"""What goes with what, by pairs: times, drifts, knowledge, feedback, risks, errors, formulations."""

import itertools
from collections.abc import Mapping, Sequence
from dataclasses import replace

import pytest

from scp_recon.api.options import PlanOptions
from scp_recon.api.planning import plan_mission
from scp_recon.errors import InputError
from scp_recon.mission.mission import Mission
from scp_recon.planning import initial_guess
from scp_recon.planning.plan import Plan, Stage
from scp_recon.planning.planner import Planner
from scp_recon.planning.stages import Pipeline
from scp_recon.results.solution import make_solution
from scp_recon.scp.status import Status
from scp_recon.verification.reintegration import verify
from tests.helpers import nightly
from tests.scp_recon.support import fly_few, mission_of

Choice = tuple[str, ...]
SMALL = ("grid.step_max_s=900", "risk.p_chance=0.9")
WORDS: Mapping[str, tuple[str, ...]] = {
    "missed": ("safety.missed_burns=true", "safety.drift_s=40000"),
    "uncertain": ("knowledge.body.gm_m3_s2=0.2", "knowledge.site.position_body_m=[1, 1, 1]"),
    "feedback": ("policy.kind=feedback", "policy.cost=expected"),
    "considering": ("policy.kind=feedback", "navigation.estimate_parameters=false"),
    "pictured": (
        "policy.kind=feedback",
        "policy.cost=expected",
        "navigation.landmarks.number=20",
        "navigation.landmarks.map_error_m=0.5",
        "navigation.landmarks.every_s=1800",
        "navigation.landmarks.pixel_error=0.5",
        "navigation.landmarks.field_of_view_deg=40",
        "navigation.landmarks.pixels=1024",
    ),
    "gates": (
        "uncertainty.gates={magnitude_fixed_m_s=5e-4, pointing_fixed_m_s=5e-4, "
        "magnitude_proportional=0.01, pointing_proportional_rad=0.01}",
        "boundary.final_sigma_position_m=300",
    ),
    "node": ("risk.allocation=exact",),
    "flight": ("risk.allocation=exact", "risk.scope=flight"),
}
MEASURED = ("navigation.sigma_position_m=10", "navigation.sigma_velocity_m_s=5e-4")
TIMES, DRIFTS, KNOWLEDGE = ("given", "free"), ("no drift", "missed"), ("known", "uncertain")
POLICIES, RISKS = ("open", "feedback", "considering", "pictured"), ("node", "flight")
ERRORS, FORMS = ("by component", "gates"), ("condensed", "lifted")


def is_planned(choice: Choice) -> bool:
    """Whether a combination has a meaning: parameters are considered where some are uncertain."""
    return not {"considering", "known"} <= set(choice)


def pairs(choice: Choice) -> set[Choice]:
    return set(itertools.combinations(choice, 2))


def covering(*factors: tuple[str, ...]) -> list[Choice]:
    """Few combinations that have every pair that is planned: greedily, the one with most new ones."""
    every = [choice for choice in itertools.product(*factors) if is_planned(choice)]
    left, found = set().union(*map(pairs, every)), []
    while left:
        found.append(max(every, key=lambda choice: len(left & pairs(choice))))
        left -= pairs(found[-1])
    return found


def mission_with(choice: Choice) -> Mission:
    words = itertools.chain(*(WORDS.get(one, ()) for one in choice))
    return mission_of(*SMALL, *(MEASURED if "pictured" not in choice else ()), *words)


def planned(choice: Choice, *, certify: bool | None) -> Plan:
    """The plan with the times that are given."""
    mission = mission_with(choice)
    options = PlanOptions(formulation=choice[-1], certify=certify, starts=1)
    return plan_mission(mission, initial_guess.cold(mission), options)


def with_free_times(fixed: Plan, form: str) -> Stage:
    """The program with free times between the first and the last burn, begun at a plan."""
    *_, end = fixed.mission.scenario.burns.times_s
    spans = ((0.0, 0.0), *[(0.0, end)] * 2, (end, end))
    mission, last = replace(fixed.mission, firing_spans_s=spans), fixed.final
    planner = Planner(mission, formulation=form, target=fixed.target)
    pipeline = Pipeline(mission, planner)
    start = pipeline.start(last.result.lin.iterate)
    if last.facets is None:
        spec = planner.exact_stages()[-1]
    else:
        spec = planner.p2_stage(last.facets, start, again=True)
    if last.result.lin.iterate.gains.any():
        start = mission.dynamics.linearise(spec.rows.problem, last.result.lin.iterate)
    return pipeline.solve(spec, start)


DAILY = covering(TIMES, DRIFTS, KNOWLEDGE, POLICIES[:2], RISKS, ERRORS, FORMS[:1])
NIGHTLY = covering(TIMES, DRIFTS, KNOWLEDGE, POLICIES, (*RISKS, "uniform"), ERRORS[:1], FORMS)


def check(choice: Choice, *, certify: bool | None) -> list[str]:
    """Plan and verify a combination; returns what the verification found wrong."""
    plan = planned(choice, certify=certify)
    assert plan.status is Status.CONVERGED
    mission, problem = plan.mission, plan.mission.problem
    assert (problem.parameters > 0) == ("uncertain" in choice)
    assert (problem.feedback is None) == ("open" in choice)
    assert bool(problem.drifts) == ("missed" in choice)
    if "free" in choice:
        freed = with_free_times(plan, choice[-1])
        assert freed.result.status is Status.CONVERGED
        cost = freed.result.lin.cost.value * mission.units.speed_m_s
        assert cost < plan.final.result.lin.cost.value * mission.units.speed_m_s
    return verify(mission, make_solution(plan)).failed


def wholly_covered(found: Sequence[Choice], *factors: Choice) -> bool:
    every = filter(is_planned, itertools.product(*factors))
    return set().union(*map(pairs, every)) == set().union(*map(pairs, found))


def test_every_pair_is_tried():
    assert wholly_covered(DAILY, TIMES, DRIFTS, KNOWLEDGE, POLICIES[:2], RISKS, ERRORS, FORMS[:1])
    assert len(DAILY) < 10


@pytest.mark.slow
@pytest.mark.parametrize("choice", DAILY, ids="-".join)
def test_pairs_work_with_exact_risk(choice, monkeypatch):
    """Not certified: few flights may find the law's probability too high, and nothing else."""
    fly_few(monkeypatch)
    failed = check(choice, certify=False)
    assert all(name.startswith("P(") for name in failed)


@nightly
@pytest.mark.parametrize("choice", NIGHTLY, ids="-".join)
def test_pairs_are_verified_in_every_form(choice):
    assert check(choice, certify=None) == []


REFUSED = [
    *(("frozen-stm", word) for word in ("missed", "uncertain", "feedback")),
    *(("tuned", word) for word in ("uncertain", "feedback")),
]


@pytest.mark.parametrize(("form", "word"), REFUSED)
def test_other_methods_refuse_in_one_line(form, word):
    mission = mission_with((word,))
    options = PlanOptions(formulation=form, method="ipopt" if form == "tuned" else "scp")
    with pytest.raises(InputError) as raised:
        plan_mission(mission, initial_guess.cold(mission), options)
    entry = {"missed": "safety", "uncertain": "knowledge", "feedback": "policy"}[word]
    assert raised.value.entry.startswith(entry)
    assert "\n" not in str(raised.value)
