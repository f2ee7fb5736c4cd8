"""Plans of the default scenario whose firing times are controls of the convex program."""

from dataclasses import replace

import numpy as np
import pytest

from formulations.linearisation.linearisation import condense
from formulations.program.multipliers import multipliers, slope_left
from formulations.rows.drift import DriftRows
from scp_recon.mission.mission import Mission
from scp_recon.mission.schedule import make_schedule
from scp_recon.planning.initial_guess import cold
from scp_recon.planning.plan import Plan, Stage
from scp_recon.planning.planner import Planner
from scp_recon.planning.stages import Pipeline
from scp_recon.scp.status import Status
from tests.helpers import nightly
from tests.scenarios import COARSE, reference
from tests.scp_recon.support import from_cold, mission_of


def with_free_times(mission: Mission, earliest_s: float = 0.0) -> Mission:
    """Inner burns within the schedule's rules, none before a time."""
    end = mission.scenario.burns.times_s[-1]
    return replace(mission, firing_spans_s=((0.0, 0.0), *[(earliest_s, end)] * 2, (end, end)))


def freed(plan: Plan, mission: Mission, formulation: str = "condensed") -> Stage:
    """P2 with the plan's facets, from its burns."""
    planner = Planner(mission, formulation=formulation)
    pipeline = Pipeline(mission, planner)
    start = pipeline.start(plan.final.result.lin.iterate)
    if plan.final.facets is None:
        spec = planner.exact_stages()[-1]
    else:
        spec = planner.p2_stage(plan.final.facets, start, again=True)
    if plan.final.result.lin.iterate.gains.any():
        start = mission.dynamics.linearise(spec.rows.problem, plan.final.result.lin.iterate)
    return pipeline.solve(spec, start)


FIRES = 1e-4
"""Nondimensional size from which the time of a burn matters: below, the optimum is flat in it."""


@pytest.fixture(scope="module")
def fixed() -> Plan:
    return reference()[1]


@pytest.fixture(scope="module")
def free(fixed) -> Stage:
    return freed(fixed, with_free_times(fixed.mission))


def times_s(fixed: Plan, stage: Stage) -> list[float]:
    moved = stage.result.lin.iterate.times * fixed.mission.units.time_s
    first, *_, last = fixed.mission.scenario.burns.times_s
    return [first, *moved.tolist(), last]


def test_free_times_save_and_keep_all_rules(fixed, free):
    assert free.result.status is Status.CONVERGED
    cost = free.result.lin.cost.value * fixed.mission.units.speed_m_s
    assert cost < 0.1354
    assert cost < 0.97 * fixed.total_dv_m_s
    times, scenario = times_s(fixed, free), fixed.mission.scenario
    assert len(free.result.records) < 15
    make_schedule(tuple(times), fixed.mission.schedule.window_s, scenario.schedule)


@pytest.mark.slow
def test_lifted_form_has_the_same_optimum(fixed, free):
    other = freed(fixed, with_free_times(fixed.mission), "lifted")
    assert other.result.lin.cost.value == pytest.approx(free.result.lin.cost.value, rel=1e-6)
    assert times_s(fixed, other) == pytest.approx(times_s(fixed, free), abs=0.1)


def test_frozen_formulations_refuse_free_times(fixed):
    with pytest.raises(ValueError, match="free firing times"):
        freed(fixed, with_free_times(fixed.mission), "frozen-stm")


def test_drifts_have_the_same_slopes_in_lifted_form():
    """The node before a burn moves less than the burn, from which a missed one drifts."""
    mission = with_free_times(mission_of("grid.step_max_s=900", "safety.missed_burns=1"))
    lin = Pipeline(mission, Planner(mission)).start(cold(mission))
    rows = DriftRows(lin.problem, 0)
    s = condense(lin)
    step = np.random.default_rng(2).normal(size=len(lin.controls))
    states = np.concatenate([s.mean_jacobian[:, :, None] @ step, s.factor_jacobian @ step], axis=2)
    here = np.concatenate([lin.iterate.mean[:, :, None], lin.factor], axis=2)
    assert len(lin.problem.time_controls) == 2
    for own, lifted in zip(rows.cones(lin), rows.state_cones(lin), strict=True):
        _, node, i, j = lifted.places
        slope = lifted.entries @ states[node, i, j] + (lifted.values @ step).item()
        assert slope == pytest.approx((own.values @ step).item(), rel=1e-9)
        value = lifted.entries @ here[node, i, j] + (lifted.values @ lin.controls).item()
        assert value + lifted.constants.item() == pytest.approx(own.at(lin.controls).item())


def test_given_times_are_no_controls(fixed):
    spans = tuple((time, time) for time in fixed.mission.scenario.burns.times_s)
    assert replace(fixed.mission, firing_spans_s=spans).problem.firing is None


MEASURED = (
    'policy.kind="feedback"',
    "navigation.sigma_position_m=10",
    "navigation.sigma_velocity_m_s=0.0005",
)


@pytest.fixture(scope="module")
def corrected() -> Plan:
    return from_cold(mission_of(COARSE, *MEASURED, "navigation.lead_s=3600"))


@pytest.fixture(scope="module")
def moved(corrected) -> Stage:
    return freed(corrected, with_free_times(corrected.mission))


def test_cut_offs_move_along_with_their_burns(corrected, moved):
    assert moved.result.status is Status.CONVERGED
    assert moved.result.lin.cost.value < 0.992 * corrected.final.result.lin.cost.value
    problem, times = moved.result.lin.problem, times_s(corrected, moved)
    nodes_s = problem.firing.at(moved.result.lin.iterate.times) * corrected.mission.units.time_s
    assert nodes_s[problem.feedback.cut_offs] == pytest.approx([times[1] - 3600.0], abs=1e-6)
    assert times[1] == pytest.approx(6601.0, abs=1e-3)
    window = corrected.mission.window_nodes
    assert nodes_s[window] == pytest.approx(corrected.mission.times_s[window])
    make_schedule(
        tuple(times), corrected.mission.schedule.window_s, corrected.mission.scenario.schedule
    )


@pytest.mark.parametrize(("gains", "left", "off"), [(False, 1e-5, 0.02), (True, 2e-3, 0.04)])
def test_multipliers_of_rules_tell_what_time_saves(gains, left, off, request):
    """A later earliest time costs what the multiplier says; and the conditions of optimality hold."""
    plan, stage = map(
        request.getfixturevalue, ("corrected", "moved") if gains else ("fixed", "free")
    )
    merit, lin = stage.merit, stage.result.lin
    prices = multipliers(merit.problem, merit.rows, lin)
    assert slope_left(merit.problem, merit.rows, lin, prices) < left
    names = lin.problem.firing.names
    first = dict(zip(names, prices[-len(names) :], strict=True))[
        "burn 2 at least 6600 s after burn 1"
    ]
    assert first > 0.0
    later = freed(plan, with_free_times(plan.mission, times_s(plan, stage)[1] + 20.0))
    dearer = later.result.lin.cost.value - lin.cost.value
    assert dearer == pytest.approx(first * 20.0 / plan.mission.units.time_s, rel=off)


@pytest.mark.parametrize(
    ("lead_s", "corrected", "free"),
    [
        (8000, [1, 2], [2]),  # the cut-off of burn 2 is at the epoch
        (9000, [2], [1]),  # that of burn 3 in the window
        (17_000, [2], None),  # that of burn 3 at burn 2, which has none after departure
    ],
)
def test_burns_stay_whose_cut_offs_have_no_room(lead_s, corrected, free):
    limited = f"navigation.lead_s={lead_s}", "boundary.final_sigma_position_m=150"
    mission = with_free_times(mission_of(*MEASURED, *limited))
    firing, unit = mission.problem.firing, mission.units.time_s
    assert mission.problem.feedback.burns.tolist() == corrected
    assert (firing and firing.burns.tolist()) == free
    if (
        lead_s == 8000
    ):  # the cut-off of burn 3 comes after the window, though the burn could be earlier
        least = dict(zip(firing.names, firing.least * unit, strict=True))
        end = mission.schedule.window_s[1]
        assert least["the cut-off of burn 3 after the window"] == pytest.approx(end + 8001.0)


def test_data_of_contacts_stay_where_they_are():
    contacts = ("navigation.contacts.every_s=3600", "navigation.contacts.turnaround_s=2000")
    mission = with_free_times(mission_of(*MEASURED, *contacts, "navigation.contacts.length_s=600"))
    problem, unit = mission.problem, mission.units.time_s
    (cut_off,) = problem.feedback.cut_offs
    assert mission.times_s[cut_off] == pytest.approx(3600.0)
    moved = problem.firing.start + np.array([-0.02, 0.01])
    assert problem.firing.at(moved)[cut_off] * unit == pytest.approx(3600.0)
    least = dict(zip(problem.firing.names, problem.firing.least * unit, strict=True))
    assert least["burn 2 at 6200 s or later, with its data"] == pytest.approx(6200.0)


def by_ipopt(mission: Mission, plan: Plan) -> tuple[float, list[float]]:
    """Least delta-v in m/s and inner times in s by single shooting, from the plan and its facets."""
    from formulations.nlp.program import Start
    from formulations.nlp.solve import VARIANTS, NlpOutcome, solve_nlp
    from scp_recon.planning.ipopt import casadi_arcs

    lin, facets = plan.final.result.lin, plan.final.facets
    start = Start(lin.iterate, lin.factor)
    arcs = casadi_arcs(mission.flow)
    found = solve_nlp(mission.problem, arcs, facets, start, VARIANTS["shooting"])
    assert found.outcome is NlpOutcome.SOLVED
    times = found.iterate.times * mission.units.time_s
    return found.objective * mission.units.speed_m_s, times.tolist()


def drawn(seed: int) -> Plan:
    rng, given = np.random.default_rng(seed), mission_of().scenario.boundary
    first = np.array(given.initial_position_m) + rng.uniform(-30.0, 30.0, 3)
    last = np.array(given.final_position_m) + rng.uniform(-60.0, 60.0, 3)
    moved = f"boundary.initial_position_m={first.tolist()}"
    error = f"uncertainty.execution_error={rng.uniform(0.02, 0.06)}"
    return from_cold(mission_of(moved, f"boundary.final_position_m={last.tolist()}", error))


@nightly
@pytest.mark.parametrize("seed", [None, *range(10)])
def test_ipopt_finds_the_same_free_times(seed, fixed):
    """Also with other boundary states and errors; the schedule is the default scenario's."""
    plan = fixed if seed is None else drawn(seed)
    assert plan.status is Status.CONVERGED
    mission = with_free_times(plan.mission)
    cost, times = by_ipopt(mission, plan)
    stage = freed(plan, mission)
    found = stage.result.lin.cost.value * mission.units.speed_m_s
    assert found == pytest.approx(cost, rel=1e-5)
    firing, moved = mission.problem.firing, stage.result.lin.iterate.times
    slack_s = (firing.matrix @ moved - firing.least) * mission.units.time_s
    ruled = np.any(firing.matrix[slack_s < 1.0] != 0.0, axis=0)  # elsewhere the optimum is flat
    fires = np.linalg.norm(stage.result.lin.iterate.burns, axis=1)[1:-1] > FIRES
    apart = np.abs(np.array(times_s(plan, stage)[1:-1]) - times)
    assert seed is not None or apart.max() < 1.0
    assert np.all(apart[fires & ruled] < 1.0)
    assert np.all(apart[fires] < 60.0)
