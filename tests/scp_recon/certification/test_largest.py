"""The largest probability: found where it ends, told where it is not known, promised as flown."""

import math
from collections.abc import Callable
from dataclasses import dataclass
from itertools import pairwise

import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.special import ndtr, ndtri

from formulations.problem.flyby import Iterate
from scp_recon.certification import largest
from scp_recon.certification.largest import (
    CLOSE,
    LEAST,
    MOST,
    SAVING,
    Search,
    Targets,
    largest_promise,
    rounded_down,
)
from scp_recon.mission.mission import Mission
from scp_recon.monte_carlo.estimates import (
    FIRST_SEED,
    TEST_CONFIDENCE,
    flights_of_test,
    proportion,
    seed_of_test,
)
from scp_recon.planning import initial_guess
from scp_recon.planning.plan import Plan
from scp_recon.planning.planner import plan
from scp_recon.scp.status import Status
from tests.scp_recon.certification.support import Reached, World, a_plan, mission_of

MEASURED = {
    "policy.kind": "feedback",
    "navigation.lead_s": 0.0,
    "navigation.sigma_position_m": 10.0,
    "navigation.sigma_velocity_m_s": 5e-4,
}

CONVERGED, LAST = Status.CONVERGED, 0.93
"""The last: probability above which there is no plan."""


@pytest.fixture(scope="module")
def real() -> Plan:
    return a_plan()


def honest(target: float, _: int) -> Reached:
    return target, target


def is_at(found: Plan, last: float) -> bool:
    return last - CLOSE * 0.2 < found.target <= last


def looked_for(world: World, patch, budget_m_s: float = math.inf) -> Plan:
    world.enter(patch)
    return Search(world.make_plan, budget_m_s).run(world.real.mission, world.start)


def ends(beyond: Status, *, shy: bool = False) -> Callable[[float, str], Status]:
    """How plans beyond the last end; if shy, none beyond 0.7 converges from the best burns."""

    def status(target: float, start: str) -> Status:
        if target > LAST:
            return beyond
        return Status.MAX_ITERATIONS if shy and start != "given" and target >= 0.7 else CONVERGED

    return status


def only_from_others(target: float, start: str) -> Status:
    """How plans end of which none is found from the first start."""
    return Status.INFEASIBLE if target > LAST or start == "given" else CONVERGED


@pytest.mark.parametrize(
    ("status", "share"),
    [
        (ends(Status.INFEASIBLE), math.inf),
        (ends(CONVERGED), LAST),
        (ends(Status.INFEASIBLE, shy=True), math.inf),
        (only_from_others, math.inf),
    ],
    ids=["infeasible", "budget", "again from the first start", "from the end of a larger one"],
)
def test_the_last_one_with_a_plan_is_found(real, monkeypatch, status, share):
    """A try that ends without a verdict is made again from the first start."""
    budget = share * real.total_dv_m_s
    found = looked_for(World(real, honest, status), monkeypatch, budget)
    assert found.status is CONVERGED
    assert is_at(found, LAST)
    assert found.mission.warnings == real.mission.warnings


@pytest.mark.parametrize("kept", [LAST, 0.98, 0.3])
def test_search_with_feedback_begins_above(real, monkeypatch, kept):
    """At what the first trial's end keeps, which may also be too much, or less than is looked for."""

    def quantile(trial: Plan) -> float:
        return float(ndtri(kept if trial.target == MOST else LAST))

    monkeypatch.setattr(largest, "kept_quantile", quantile)
    (world := World(real, honest, ends(Status.INFEASIBLE))).enter(monkeypatch)
    found = Search(world.make_plan).run(real.mission.changed(MEASURED), world.start)
    assert is_at(found, LAST)
    assert world.aims[0] == MOST
    assert (LEAST in world.aims) == (kept == 0.3)
    assert len(world.aims) < 7 or kept == 0.3


def test_always_feasible_search_ends_at_certifiable_limit(real, monkeypatch):
    found = looked_for(World(real, honest), monkeypatch)
    assert ndtri(MOST) - ndtri(found.target) <= CLOSE


def test_no_verdict_is_told_from_infeasible(real, monkeypatch):
    found = looked_for(World(real, honest, ends(Status.STALLED)), monkeypatch)
    assert is_at(found, LAST)
    told = found.mission.warnings[-1]
    assert told.entry == "risk.p_chance"
    assert "stalled" in told.given
    assert "may be feasible" in told.expected


def test_ctrl_c_ends_search_with_best_plan(real, monkeypatch):
    def status(target: float, _: str) -> Status:
        return Status.CONVERGED if target < 0.97 else Status.INTERRUPTED

    world = World(real, honest, status)
    found = looked_for(world, monkeypatch)
    assert found.status is Status.INTERRUPTED
    assert found.target == max(target for target in world.aims if target < 0.97)
    assert world.aims[-1] >= 0.97  # and nothing is tried after it


def promised(world: World, patch, *, certified: bool) -> Plan:
    world.enter(patch)
    search = Search(world.make_plan, LAST * world.real.total_dv_m_s)
    return largest_promise(world.real.mission, world.start, search, certified=certified)


def test_what_it_aims_at_is_asked_without_flights(real, monkeypatch):
    found = promised(World(real, honest), monkeypatch, certified=False)
    assert found.certificate is None
    assert found.mission.scenario.risk.p_chance == rounded_down(found.target)


def test_lower_limit_of_a_test_is_promised(real, monkeypatch):
    """Of flights that no round has used, whatever those reached."""

    def reach(target: float, seed: int) -> Reached:
        return (share := target - 0.01 * (seed == seed_of_test(1))), share

    found = promised(world := World(real, reach), monkeypatch, certified=True)
    reached = found.certificate
    assert world.seeds == [FIRST_SEED, seed_of_test(1)]
    assert (reached.samples, reached.seed) == (flights_of_test(found.target), seed_of_test(1))
    kept = round((found.target - 0.01) * reached.samples)
    assert reached.low == proportion(kept, reached.samples, TEST_CONFIDENCE).low
    assert found.mission.scenario.risk.p_chance == rounded_down(reached.low) < found.target


def test_search_repeats_on_added_nodes(real, monkeypatch):
    between = float(real.times_s[70]) + 20.0

    def reach(target: float, seed: int) -> Reached:
        return target, target - 0.05 * (seed == FIRST_SEED)

    world = World(real, reach, touched_s=(between,))
    found = promised(world, monkeypatch, certified=True)
    assert (found.certificate.rounds, found.certificate.tests) == (2, 1)
    assert world.seeds == [FIRST_SEED, FIRST_SEED + 1, seed_of_test(1)]
    assert found.certificate.at_nodes == found.certificate.reached
    assert round(between) in found.times_s
    assert world.aims.count(LEAST) == 2


@pytest.mark.parametrize("stop", [FIRST_SEED, seed_of_test(1)])
def test_ctrl_c_among_its_flights_keeps_the_plan(real, monkeypatch, stop):
    def reach(target: float, seed: int) -> Reached:
        if seed == stop:
            raise KeyboardInterrupt
        return target, target

    found = promised(World(real, reach), monkeypatch, certified=True)
    assert found.status is Status.INTERRUPTED
    assert found.certificate is None
    assert is_at(found, LAST)


@pytest.mark.slow
@pytest.mark.parametrize(("changes", "budget"), [({}, 0.1095), (MEASURED, 0.1125)])
def test_the_budget_buys_so_much_and_no_more(changes, budget):
    """On the default scenario, roughly; with feedback it is for what is commanded in flight."""
    mission, close = mission_of("node").changed(changes), 1.0
    tries: list[tuple[Iterate | Plan, Plan]] = []

    def make_plan(mission: Mission, start: Iterate | Plan, target: float, **how: bool) -> Plan:
        tries.append((start, plan(mission, start, target=target, **how)))
        return tries[-1][1]

    best = Search(make_plan, budget, close).run(mission, initial_guess.cold(mission))
    assert best.total_dv_m_s <= best.cost_m_s <= budget
    assert (best.total_dv_m_s < best.cost_m_s) == bool(changes)
    more = [made.target for _, made in tries if made.cost_m_s > budget]
    assert best.target < min(more) <= ndtr(ndtri(best.target) + close)
    lin = best.final.result.lin
    if lin.problem.feedback is None:
        return
    # Limits on corrected burns hold with what is looked for, and tries go on from gains.
    assert lin.problem.feedback.probability == best.target > mission.scenario.risk.p_chance
    assert any(start is best for start, _ in tries)


FRONTIER = (0.6, 0.9, 0.99)


@dataclass
class Fake:
    """A trial in a basin: of a price, with plans up to a target."""

    price: float
    most: float
    target: float

    @property
    def status(self) -> Status:
        return Status.CONVERGED if self.target <= self.most else Status.INFEASIBLE

    @property
    def cost(self) -> float:
        return self.price + self.target


BASINS = st.lists(
    st.tuples(st.floats(0.1, 3.0), st.floats(0.55, 1.0), st.sampled_from(FRONTIER)),
    min_size=1,
    max_size=4,
)


@given(basins=BASINS, order=st.permutations(FRONTIER))
def test_no_higher_target_costs_less(basins, order):
    """From the first start each target leads to a basin of its own; others stay in that of theirs."""

    def make(start: Fake | None, target: float) -> Fake:
        if start is None:
            price, most, _ = min(basins, key=lambda one: abs(one[2] - target))
            return Fake(price, most, target)
        return Fake(start.price, start.most, target)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(largest, "cost_of", lambda trial: trial.cost)
        work = Targets(make)
        for target in order:
            work.plan(None, target)
        found = [work.plan(None, target) for target in FRONTIER]
    for lower, higher in pairwise(found):
        if higher.status is Status.CONVERGED:
            assert lower.status is Status.CONVERGED
            assert lower.cost <= higher.cost / (1.0 - SAVING)


@pytest.mark.parametrize(("first", "then"), [(0.6, 0.9), (0.99, 0.9)])
def test_other_target_leads_where_its_own_ends(monkeypatch, first, then):
    """From the first start only one target has a plan; the other is found from that one."""
    monkeypatch.setattr(largest, "cost_of", lambda trial: trial.cost)

    def make(start: Fake | None, target: float) -> Fake:
        lost = start.most < 1.0 if start else target == then
        return Fake(1.0, 0.5 if lost else 1.0, target)

    work = Targets(make)
    assert work.plan(None, first).status is Status.CONVERGED
    found = work.plan(None, then)
    assert (found.status, found.target) == (Status.CONVERGED, then)
