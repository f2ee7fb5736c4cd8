"""Plans that spend the risk that was asked for: what they cost and reach, and what they refuse."""

from dataclasses import replace
from functools import cache, partial
from itertools import pairwise
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from hypothesis import HealthCheck, Phase, assume, given, settings
from scipy.special import ndtr

from formulations.arrays import Array
from formulations.linearisation.linearisation import Linearisation
from formulations.rows.exact import NodeRows
from formulations.rows.exact_flight import FLIGHT, FlightRows
from formulations.rows.node_probability import SPREAD_MIN
from scp_recon.errors import InputError
from scp_recon.mission.mission import Mission
from scp_recon.planning import initial_guess, ipopt
from scp_recon.planning import planner as planning
from scp_recon.planning.plan import StageSpec
from scp_recon.planning.planner import Plan, Planner, plan
from scp_recon.planning.stages import Pipeline
from scp_recon.scenario.load import load_scenario
from scp_recon.scp.status import Status
from tests.helpers import nightly, share_of_examples, usually
from tests.properties.test_optimality import Values, conditions_of
from tests.scenarios import COARSE, planned, scenarios
from tests.scp_recon.support import from_cold, mission_of, sigma_of

pytestmark = pytest.mark.slow

GOALS = usually(
    [
        *(("flight", 0.99, 0.1256), ("flight", 0.9, 0.1102), ("node", 0.99, 0.1166)),
        *(("node", 0.9, 0.1101), ("node", 0.7, 0.1087), ("node", 0.95, 0.1109)),
        *(("node", 0.997, 0.1320), ("flight", 0.7, 0.1087), ("flight", 0.95, 0.1114)),
    ],
    5,
)
"""Scope, probability, and most delta-v in m/s, of the default scenario from a cold start."""


def exact(scope: str, p: float, *others: str) -> tuple[str, ...]:
    return ("risk.allocation=exact", f"risk.scope={scope}", f"risk.p_chance={p}", *others)


@cache
def found(scope: str, p: float, algorithm: str = "scvx") -> Plan:
    return from_cold(mission_of(*exact(scope, p)), algorithm=algorithm)


@pytest.mark.parametrize(("scope", "p", "goal"), usually(GOALS, 3))
def test_the_default_scenario_from_a_cold_start(scope, p, goal):
    of = found(scope, p)
    assert of.status is Status.CONVERGED
    assert of.final.name in ("P2", "P2.held")
    assert of.final.facets is None
    assert of.total_dv_m_s <= goal
    assert min(margin for margin, _ in of.worst_margins.values()) > -1e-5
    # The risk is spent: something binds.
    sigmas = [margin for margin, unit in of.worst_margins.values() if unit == "sigma"]
    assert min(sigmas) < 1e-5


def test_cost_grows_with_probability_and_scope():
    costs = {(scope, p): found(scope, p).total_dv_m_s for scope, p, _ in sorted(GOALS)}
    for one, other in pairwise(costs):
        assert one[0] != other[0] or costs[one] < costs[other]
    assert all(costs["flight", p] > costs["node", p] for scope, p in costs if scope == "flight")


@pytest.mark.parametrize("scope", ["node", "flight"])
def test_a_plan_continues_with_its_last_stage(scope):
    near, end = found(scope, 0.9), found(scope, 0.99)
    on = plan(end.mission, near)
    assert {stage.name for stage in on.stages} <= {"P2", "P2.held"}
    assert on.total_dv_m_s == pytest.approx(end.total_dv_m_s, rel=1e-4)


def test_other_risk_begins_at_a_plan_s_burns():
    uniform = plan(mission_of(), found("node", 0.9))
    assert uniform.status is Status.CONVERGED
    assert [stage.name for stage in uniform.stages] == ["P3", "P2"]


@settings(
    max_examples=share_of_examples(30),
    phases=[Phase.explicit, Phase.reuse, Phase.generate],
    suppress_health_check=[HealthCheck.too_slow, HealthCheck.filter_too_much],
)
@given(scenarios())
def test_exact_risk_never_costs_more_than_polytopes(overrides):
    try:
        mission, uniform = planned(overrides)
    except InputError:
        assume(False)
    assume(uniform.status is Status.CONVERGED)
    p = mission.scenario.risk.p_chance
    of = Mission.from_scenario(load_scenario(None, (*overrides, *exact("node", p))))
    stage = Pipeline(of, Planner(of)).exact(uniform.final.result.lin)
    assert stage.result.status is Status.CONVERGED
    # Where nothing is uncertain it keeps off the limits by its least spread, which polytopes have not.
    off = 10.0 * SPREAD_MIN
    assert (
        stage.result.lin.iterate.total_dv
        <= uniform.final.result.lin.iterate.total_dv * (1.0 + off) + 1e-7
    )


@nightly
def test_better_measurements_never_cost_more():
    """Each begins at the plan before it, the first at the plan without corrections."""
    last = found("flight", 0.9)
    for metres in (10.0, 3.0, 1.0):
        measured = (
            f"navigation.sigma_position_m={metres}",
            f"navigation.sigma_velocity_m_s={5e-5 * metres}",
        )
        given = exact("flight", 0.9, "policy.kind=feedback", "navigation.lead_s=0", *measured)
        of = Planner(mission_of(*given)).plan(last)
        assert of.status is Status.CONVERGED
        before, after = (one.final.result.lin.cost.value for one in (last, of))
        assert after <= before * (1.0 + 1e-4)
        last = of


def kept(of: Plan, count: int) -> Array:
    """Which of fresh flights of the linear law keep every limit on the position at every node."""
    lin, problem = of.final.result.lin, of.mission.problem
    rng = np.random.default_rng(77)
    w = rng.normal(size=(count, lin.factor.shape[2]))
    good = np.ones(count, dtype=np.bool_)
    for constraint in problem.constraints:
        for k, node in enumerate(constraint.nodes):
            points = lin.iterate.mean[node, :3] + w @ lin.factor[node, :3].T
            depth = constraint.region.at(np.full(count, k)).inside(points)
            good &= depth > 0.0 if constraint.keep == "in" else depth < 0.0
    return good


@pytest.mark.parametrize(("p", "optimism"), [(0.9, 2e-3), (0.99, 1e-3)])
def test_fresh_flights_hold_as_often_as_asked(p, optimism):
    """But for what is lost by optimising against the same directions."""
    count = 20_000
    share = float(kept(found("flight", p), count).mean())
    assert share == pytest.approx(p, abs=4.0 * np.sqrt(p * (1.0 - p) / count) + optimism)


def test_whole_flight_plans_hold_at_every_node():
    of = found("flight", 0.9)
    lin = of.final.result.lin
    nodes = NodeRows(of.mission.problem, 0.9).margins(lin)
    assert min(part.margin.min() for part in nodes.values()) > 0.0
    (flight,) = of.final.merit.rows.margins(lin).values()
    assert flight.margin[0] == pytest.approx(0.0, abs=2e-5)
    (even,) = FlightRows(of.mission.problem, 0.9, 4096, 1e-5).margins(lin).values()
    assert even.margin[0] == pytest.approx(0.0, abs=0.01)  # directions that are not aimed
    assert set(of.worst_margins) == {"dv_max", "dv_battery", FLIGHT}
    reached = min(float(ndtr(part.margin.min() + 1.2815515655446004)) for part in nodes.values())
    assert reached > 0.9


@pytest.mark.parametrize(
    ("scope", "p"), usually([("flight", 0.9), ("node", 0.9), ("node", 0.99)], 2)
)
def test_exact_plans_satisfy_the_first_order_conditions(scope, p):
    """The mean rolled out and linearised anew for each of the burns; no slope of a row is used."""
    of = found(scope, p)
    mission, rows = of.mission, of.final.merit.rows
    problem, dynamics = mission.problem, mission.dynamics

    def values(points: Array) -> Values:
        means = dynamics.rollout(
            np.broadcast_to(problem.initial_state, (len(points), 6)), points
        ).swapaxes(0, 1)
        kept_by = []
        for burns, mean in zip(points, means, strict=True):
            lin = dynamics.linearise(problem, initial_guess.Iterate(burns, mean))
            limits = [part.margin for part in rows.margins(lin).values()]
            kept_by.append(np.concatenate([*limits, *problem.burn_margins(burns).values()]))
        size = np.linalg.norm(points, axis=2)
        return Values(size.sum(axis=1), np.array(kept_by), means[:, -1] - problem.final_state)

    at = conditions_of(mission, of.final.result.lin.iterate.burns, values)
    assert at.infeasibility < 1e-5
    assert at.residual < RESIDUAL[scope]
    assert at.complementarity < 1e-5


RESIDUAL = {"node": 1e-4, "flight": 2e-3}
"""Of stationarity, against the gradient of the cost; a flight's stage stops at 1e-5 of the merit."""


@pytest.mark.parametrize("scope", usually(["node", "flight"], 1))
def test_an_exact_plan_can_be_planned_again(scope):
    mission = mission_of(*exact(scope, 0.9, COARSE))
    planner = Planner(mission)
    first = planner.plan(initial_guess.cold(mission))
    state = mission.initial_state + 0.5 * sigma_of(mission) * np.array([1, -1, 1, -1, 1, 0.5])
    moved = planner.replan(first, state)
    assert moved.status is Status.CONVERGED
    assert moved.final.name in ("P2", "P2.held")
    assert moved.final.merit.worst_violation(moved.final.result.lin) <= moved.final.tolerance
    if scope == "node":
        anew = from_cold(moved.mission)
        assert moved.total_dv_m_s == pytest.approx(anew.total_dv_m_s, rel=1e-3)


def never(*_: object) -> None:
    raise AssertionError("what is refused is refused before any work")


EXACT = exact("node", 0.9)
SPREAD = ("boundary.final_sigma_velocity_m_s=0.01",)
SIGMAS = "navigation.sigma_position_m=10", "navigation.sigma_velocity_m_s=5e-4"
FROZEN = partial(plan, formulation="frozen-stm")


@pytest.mark.parametrize(
    ("overrides", "planned", "words"),
    [
        (EXACT, FROZEN, r"risk\.allocation: .*condensed and lifted"),
        (EXACT, partial(plan, formulation="frozen-covariance"), r"risk\.allocation: .*lifted"),
        (EXACT, ipopt.plan, r"risk\.allocation: .*scp"),
        (SPREAD, FROZEN, r"boundary\.final_sigma_velocity_m_s: .*condensed and lifted"),
        (SPREAD, partial(ipopt.plan, variant="printed"), r"boundary\.final_sigma_vel.*: .*scp"),
        (("policy.kind=feedback", *SIGMAS), FROZEN, r"policy\.kind: .*condensed and lifted"),
    ],
)
def test_methods_refuse_rows_they_lack(overrides, planned, words):
    mission = mission_of(COARSE, *overrides)
    with pytest.raises(InputError, match=f"^{words}"):
        planned(mission, initial_guess.cold(mission), observe=never)


@pytest.mark.parametrize(
    ("gains", "ends", "names"),
    [
        # led to where there is no plan without, however the leading stage ends
        (0.0, "ccc", ["P2.node", "P2.coarse", "P2"]),
        (0.0, "icc", ["P2.node", "P2.led", "P2"]),
        (0.0, "iic", ["P2.node", "P2.led", "P2"]),
        (0.0, "ci", ["P2.node", "P2.coarse"]),
        # a plan with them that does not go on at once goes on with them
        (1.0, "c", ["P2"]),
        (1.0, "icc", ["P2", "P2.coarse", "P2"]),
        (1.0, "ii", ["P2", "P2.coarse"]),
    ],
)
def test_gains_are_led_to_or_kept(gains, ends, names, monkeypatch):
    """Stages that end converged or infeasible, of the product's list of stages."""
    ended, seen = iter(ends), list[str]()
    mission = mission_of(
        COARSE, "policy.kind=feedback", *SIGMAS, "navigation.lead_s=0", *exact("flight", 0.9)
    )
    planner, pipeline = Planner(mission), Pipeline(mission, Planner(mission))
    lin = pipeline.start(initial_guess.cold(mission))
    given = np.full(mission.problem.feedback.size, gains)
    start = mission.dynamics.linearise(mission.problem, replace(lin.iterate, gains=given))

    def solve(spec: StageSpec, at: Linearisation) -> Any:
        seen.append(spec.name)
        status = Status.CONVERGED if next(ended) == "c" else Status.INFEASIBLE
        return SimpleNamespace(result=SimpleNamespace(status=status, lin=at))

    monkeypatch.setattr(pipeline, "solve", solve)
    begun = start.iterate
    stage = planning.continued(pipeline, begun, once=False) if gains else pipeline.exact(start)
    assert seen == names
    assert (stage is None) == (gains > 0.0 and ends[-1] == "i")
    assert [one.name for one in planner.exact_stages()] == ["P2.node", "P2.coarse", "P2"]
