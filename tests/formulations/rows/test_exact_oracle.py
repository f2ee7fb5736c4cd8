"""Exact risk against nonlinear programs in the burns, whose probabilities are of other code."""

import numpy as np
import pytest
from scipy.special import ndtr

from formulations.linearisation.linearisation import Linearisation
from formulations.rows.node_probability import joint_events, node_quantiles
from scp_recon.mission.mission import Mission
from scp_recon.planning import initial_guess
from scp_recon.planning.plan import Plan
from scp_recon.planning.planner import plan
from scp_recon.scenario.load import load_scenario
from tests.helpers import nightly
from tests.normal_law import cone_probability
from tests.oracles.burns_program import BurnsProgram, FlightRow, NodeRows, ray_quantiles
from tests.oracles.burns_search import search

EXACT = {"risk.allocation": "exact", "risk.p_chance": 0.9}


@pytest.fixture(scope="module")
def exact() -> Mission:
    return Mission.from_scenario(load_scenario().replace(EXACT))


@pytest.fixture(scope="module")
def planned(exact) -> Plan:
    return plan(exact, initial_guess.cold(exact))


@pytest.fixture(scope="module")
def p3(exact) -> Linearisation:
    return plan(exact, initial_guess.cold(exact), problem="P3").final.result.lin


def test_ray_quantiles_are_the_planners(exact, planned):
    lin = planned.final.result.lin
    event = next(e for e in joint_events(exact.problem.constraints) if e.name == "emission")
    event = event.at(np.arange(len(event.nodes) - 4, len(event.nodes)))
    mean, factor = lin.iterate.mean[event.nodes, :3], lin.factor[event.nodes, :3]
    ours, theirs = ray_quantiles(event, mean, factor), node_quantiles(event, mean, factor)
    (outer,), (inner,) = event.keep_in, event.keep_out
    for i, node in enumerate(ours.value):
        covariance, one = factor[i] @ factor[i].T, np.array([i])
        within = [cone_probability(r.at(one), mean[i], covariance) for r in (outer, inner)]
        assert ndtr(node) == pytest.approx(within[0] - within[1], abs=1e-4)
    assert ours.value == pytest.approx(theirs.value, abs=1e-3)
    for mine, planners in ((ours.by_mean, theirs.by_mean), (ours.by_factor, theirs.by_factor)):
        assert np.abs(mine - planners).max() < 5e-3 * np.abs(planners).max()


@pytest.mark.parametrize("scope", ["node", "flight"])
def test_program_derivatives_are_finite_differences(scope, exact, planned):
    problem, lin = exact.problem, planned.final.result.lin
    rows = NodeRows(problem, 0.9, 8192) if scope == "node" else FlightRow(problem, 0.9, 64)
    nlp = BurnsProgram(exact, rows, 1e-3, np.inf, lin, 100)
    z = lin.iterate.burns.ravel() + 1e-3
    direction = np.random.default_rng(3).standard_normal(len(z))
    here, step = nlp.at(z), 1e-5
    ahead, behind = (nlp.at(z + move * direction) for move in (step, -step))
    for value, slope, error in (
        ("cost", "by_cost", 1e-5),
        ("equal", "by_equal", 1e-5),
        ("least", "by_least", 2e-2),
    ):
        expected = (getattr(ahead, value) - getattr(behind, value)) / (2.0 * step)
        found = getattr(here, slope) @ direction
        assert np.abs(found - expected).max() <= error * np.abs(expected).max()


@nightly
def test_slsqp_reaches_the_planners_optimum(exact, planned, p3):
    found = search(exact, p3, 60.0)
    assert found is not None
    cost = np.linalg.norm(found, axis=1).sum() * exact.units.speed_m_s
    assert cost == pytest.approx(planned.total_dv_m_s, rel=5e-4)
