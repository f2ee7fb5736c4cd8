"""Exact risk against nonlinear programming: the same problem by other means, and its claims."""

from __future__ import annotations

from dataclasses import replace
from functools import partial

import numpy as np
import pytest
from scipy.special import ndtr

from experiments.compare_solvers.cases import (
    Cell,
    exact_design,
)
from experiments.compare_solvers.cell import Row, failed_row
from experiments.compare_solvers.claims import (
    MISS_M,
    WITHIN,
    exact_claims,
    holds,
    verdicts,
)
from experiments.compare_solvers.exact.check import check
from experiments.compare_solvers.exact.program import (
    BurnsProgram,
    FlightRow,
    NodeRows,
    ProbabilityRows,
    burn_limits,
    ray_quantiles,
)
from experiments.compare_solvers.exact.search import search
from formulations.arrays import Array
from formulations.linearisation.linearisation import Linearisation
from formulations.rows.node_probability import joint_events, node_quantiles
from scp_recon.mission.mission import Mission
from scp_recon.planning import initial_guess
from scp_recon.planning.plan import Plan
from scp_recon.planning.planner import plan
from scp_recon.scenario.load import load_scenario
from tests.helpers import usually
from tests.normal_law import cone_probability

EXACT = {"risk.allocation": "exact", "risk.p_chance": 0.9}


@pytest.fixture(scope="module")
def exact() -> Mission:
    return Mission.from_scenario(load_scenario().replace(EXACT))


@pytest.fixture(scope="module")
def planned(exact: Mission) -> Plan:
    return plan(exact, initial_guess.cold(exact))


@pytest.fixture(scope="module")
def p3(exact: Mission) -> Linearisation:
    return plan(exact, initial_guess.cold(exact), problem="P3").final.result.lin


# --- the probability along rays -------------------------------------------------------------------


def test_rays_agree_with_nested_quadrature_and_with_the_planner(
    exact: Mission, planned: Plan
) -> None:
    lin = planned.final.result.lin
    event = next(e for e in joint_events(exact.problem.constraints) if e.name == "emission")
    event = event.at(np.arange(len(event.nodes) - 4, len(event.nodes)))
    mean, factor = lin.iterate.mean[event.nodes, :3], lin.factor[event.nodes, :3]
    ours, theirs = ray_quantiles(event, mean, factor), node_quantiles(event, mean, factor)
    (outer,), (inner,) = event.keep_in, event.keep_out
    for i, node in enumerate(ours.value):
        covariance, one = factor[i] @ factor[i].T, np.array([i])
        within = [cone_probability(r.at(one), mean[i], covariance) for r in (outer, inner)]  # type: ignore[arg-type]
        assert ndtr(node) == pytest.approx(within[0] - within[1], abs=1e-4)
    assert ours.value == pytest.approx(theirs.value, abs=1e-3)
    for mine, planners in ((ours.by_mean, theirs.by_mean), (ours.by_factor, theirs.by_factor)):
        assert np.abs(mine - planners).max() < 5e-3 * np.abs(planners).max()


# --- the program ----------------------------------------------------------------------------------


def program(mission: Mission, rows: ProbabilityRows, start: Linearisation) -> BurnsProgram:
    return BurnsProgram(mission, rows, 1e-3, np.inf, start, 100)


@pytest.mark.parametrize("scope", ["node", "flight"])
def test_the_program_has_its_own_derivatives(scope: str, exact: Mission, planned: Plan) -> None:
    problem, lin = exact.problem, planned.final.result.lin
    rows = NodeRows(problem, 0.9, 8192) if scope == "node" else FlightRow(problem, 0.9, 64)
    nlp, z = program(exact, rows, lin), lin.iterate.burns.ravel() + 1e-3
    direction = np.random.default_rng(3).standard_normal(len(z))
    here, step = nlp.at(z), 1e-5
    ahead, behind = (nlp.at(z + move * direction) for move in (step, -step))
    for value, slope, error in (
        ("cost", "by_cost", 1e-5),
        ("equal", "by_equal", 1e-5),
        ("least", "by_least", 2e-2),
    ):
        expected = (getattr(ahead, value) - getattr(behind, value)) / (2.0 * step)
        told = getattr(here, slope) @ direction
        assert np.abs(told - expected).max() <= error * np.abs(expected).max()


def test_limits_of_the_burns_are_the_problems(exact: Mission) -> None:
    problem = exact.problem
    burns = np.random.default_rng(0).normal(scale=problem.dv_max, size=(problem.n_burns, 3))
    margins, jacobian = burn_limits(problem, burns)
    size, toward, away = margins.reshape(3, -1)
    told = problem.burn_margins(burns)
    assert np.array_equal(size >= 0.0, told["dv_max"] >= 0.0)
    assert np.minimum(toward, away) == pytest.approx(told["dv_battery"])
    step = 1e-6 * np.random.default_rng(1).standard_normal(burns.shape)
    ahead, behind = (burn_limits(problem, burns + way * step)[0] for way in (1.0, -1.0))
    assert jacobian @ step.ravel() == pytest.approx(0.5 * (ahead - behind), rel=1e-4, abs=1e-11)


# --- the searches and the check ---------------------------------------------------------------------


@pytest.mark.parametrize("solver", usually(["IPOPT", "SLSQP"], 1))
def test_references_reach_the_planners_optimum(
    solver: str, exact: Mission, planned: Plan, p3: Linearisation
) -> None:
    found = search(exact, {"P3": p3}, solver, 60.0)
    assert found.holds
    cost = np.linalg.norm(found.burns, axis=1).sum() * exact.units.speed_m_s
    assert cost == pytest.approx(planned.total_dv_m_s, rel=5e-4)


@pytest.mark.parametrize("scope", ["node", "flight"])
def test_the_check_finds_what_was_asked_and_what_was_not_met(scope: str, planned: Plan) -> None:
    mission = Mission.from_scenario(load_scenario().replace(EXACT | {"risk.scope": scope}))
    burns = (
        planned.burns_m_s
        if scope == "node"
        else plan(mission, initial_guess.cold(mission)).burns_m_s
    )
    found = check(mission, burns)
    assert found.probability == pytest.approx(0.9, abs=2e-3)
    assert found.error < 2e-3
    assert found.violation_m < MISS_M
    worse = check(mission, 1.02 * burns)
    assert worse.violation_m > 1.0
    assert worse.total_dv_m_s == pytest.approx(1.02 * found.total_dv_m_s)


# --- the scenarios ----------------------------------------------------------------------------------


# --- the claims -------------------------------------------------------------------------------------


def row_of(cell: Cell, cost: float, reached: float = 0.9, status: str = "converged") -> Row:
    return replace(
        failed_row(cell, ""),
        status=status,
        problem="P2",
        total_dv_m_s=cost,
        violation_m=1e-4,
        asked=0.9,
        reached=reached,
        reached_error=1e-4,
        cpu_s=1.0,
    )


def rows_with(ours: float, theirs: Array | list[float], **about: object) -> list[Row]:
    planner, *others = exact_design(range(1))
    make = partial(row_of, planner, ours)
    return [make(**about), *map(row_of, others, theirs)]  # type: ignore[arg-type]


def test_the_best_of_all_is_what_a_plan_is_held_against() -> None:
    rows = rows_with(0.1002, [0.11, 0.1])
    (verdict,) = verdicts(rows)
    assert verdict.excess == pytest.approx(2e-3)
    assert [claim.holds for claim in exact_claims(rows)] == [True, True]
    dear = rows_with(0.1 * (1.0 + 1.1 * WITHIN), [0.11, 0.1])
    assert [claim.holds for claim in exact_claims(dear)] == [False, True]
    assert "not in: node 00 (+0.33 %)" in exact_claims(dear)[0].measured


def test_what_misses_the_probability_or_did_not_converge_is_no_answer() -> None:
    rows = rows_with(0.1, [0.09, 0.1])
    assert verdicts(rows)[0].excess > WITHIN
    rows[1] = replace(rows[1], reached=0.85)
    assert verdicts(rows)[0].excess == 0.0
    assert not holds(replace(rows[1], reached=0.9, violation_m=5.0))
    for about in ({"reached": 0.8}, {"status": "infeasible"}):
        rows = rows_with(0.1, [0.1] * 2, **about)
        assert verdicts(rows)[0].excess == np.inf
        assert exact_claims(rows)[0].holds is False
    assert exact_claims(rows_with(0.1, [0.1] * 2, reached=0.8))[1].holds is False
