"""Rows of drifts after a missed or cut burn: their law, derivatives, and what they leave unchanged."""

from dataclasses import replace
from functools import cache

import casadi as ca
import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.special import ndtri

from formulations.arrays import Array
from formulations.linearisation.linearisation import Linearisation
from formulations.problem.controls import UNIT
from formulations.problem.flyby import Iterate
from formulations.problem.regions import Ball
from formulations.program.multipliers import adjoint
from formulations.rows.drift import FAR, Branch, DriftRows, Start, start_of, tangent
from formulations.rows.exact import NodeRows
from formulations.rows.node_probability import Event
from scp_recon.mission.constraints import CUTS, drift_duration_s
from scp_recon.mission.mission import Mission
from scp_recon.planning import initial_guess, ipopt
from scp_recon.planning.ipopt import casadi_arcs
from scp_recon.planning.planner import Planner, plan
from scp_recon.planning.solver import GROWN
from scp_recon.scenario.load import load_scenario
from scp_recon.scenario.schema import Scenario
from scp_recon.scp.status import Status
from tests.helpers import nightly
from tests.scenarios import COARSE

pytestmark = pytest.mark.slow

EXACT = ("risk.allocation='exact'", COARSE)
MISSED = "safety.missed_burns=1"


@cache
def planned(*entries: str) -> Linearisation:
    mission = Mission.from_scenario(load_scenario(None, (*EXACT, *entries)))
    return plan(mission, initial_guess.cold(mission)).final.result.lin


def at_plan_without(*entries: str) -> tuple[Mission, Linearisation]:
    """A mission with drifts, at the plan without: drifts there are near to their limits."""
    mission = Mission.from_scenario(load_scenario(None, (*EXACT, *entries)))
    return mission, mission.dynamics.linearise(mission.problem, planned().iterate)


@pytest.mark.parametrize("entry", [MISSED, "safety.cut_short=true"])
def test_slopes_of_drifts_are_derivatives(entry):
    """By differences of fourth order of values evaluated anew, in all burns."""
    mission, lin = at_plan_without(entry)
    problem = replace(mission.problem, drifts=mission.problem.drifts[:2])
    controls, h = lin.controls, 1e-6

    def values(moved: Array) -> Array:
        burns = moved.reshape(-1, 3)
        states = mission.dynamics.rollout(problem.initial_state, burns)
        there = mission.dynamics.linearise(problem, Iterate(burns, states))
        return np.array([Branch(one).anew(start_of(there, one)).value for one in problem.drifts])

    def difference(step: Array) -> Array:
        one, two = (values(controls + k * step) - values(controls - k * step) for k in (1, 2))
        return (8.0 * one - two) / (12.0 * h)

    slopes = np.array([cone.values[0, 0] for cone in DriftRows(problem, 0).cones(lin)])
    expected = np.array([difference(step) for step in h * np.eye(12)]).T
    scale = np.abs(expected).max(axis=1, keepdims=True)
    np.testing.assert_allclose(slopes / scale, expected / scale, rtol=0.0, atol=1e-6)


def test_slopes_of_drifts_follow_firing_times():
    """By differences too, where burns 2 and 3 move; the drifts' own forces do not."""
    given, start = at_plan_without(MISSED, "spacecraft.reflectivity_coefficient=0")
    spans = ((0.0, 0.0), (0.0, 3e4), (0.0, 3e4), (34_842.0, 34_842.0))
    mission = replace(given, firing_spans_s=spans)
    problem = replace(mission.problem, drifts=mission.problem.drifts[:2])
    rows, burns, h = DriftRows(problem, 0), start.iterate.burns, 1e-5
    assert problem.firing is not None

    def at(times: Array) -> Linearisation:
        mean = mission.dynamics.at(problem, times).rollout(problem.initial_state, burns)
        return mission.dynamics.linearise(problem, Iterate(burns, mean, times=times))

    now = problem.firing.start
    slopes = [cone.values[0, 0, problem.time_controls] for cone in rows.cones(at(now))]
    steps = h * UNIT * np.eye(len(now))
    ahead, behind = (
        np.array([[found.value for found in rows.at(at(now + side * step))] for step in steps])
        for side in (1, -1)
    )
    expected = (ahead - behind).T / (2 * h)
    assert np.abs(expected[:, 0]).min() > 1e-3
    np.testing.assert_allclose(slopes, expected, rtol=1e-2, atol=1e-6)


@pytest.mark.parametrize("distance", [0.6, 3.0])
def test_tangent_planes_turn_with_the_mean(distance):
    """Derivatives of the least room over deviation, inside the ball and outside."""
    rng = np.random.default_rng(8)
    event = Event("drift", np.arange(3), (), (Ball(np.zeros((3, 3)), 1.0),))
    mean, factor = rng.normal(size=(3, 6)), 0.1 * rng.normal(size=(3, 6, 6))
    mean[:, :3] *= distance / np.linalg.norm(mean[:, :3], axis=1, keepdims=True)
    _, by_mean, by_factor = tangent(event, mean, factor)
    step, kick = 1e-6 * rng.normal(size=mean.shape), 1e-6 * rng.normal(size=factor.shape)
    ahead, behind = (tangent(event, mean + s * step, factor + s * kick)[0] for s in (1.0, -1.0))
    expected = np.sum(by_mean * step[:, :3]) + np.sum(by_factor * kick)
    assert (ahead - behind) / 2 == pytest.approx(expected, rel=1e-6)


def test_rows_pull_at_states_as_at_burns():
    """The adjoint of a row's pull, at its burns, is minus its slope."""
    mission, lin = at_plan_without(MISSED)
    rows = NodeRows(mission.problem, 0.7)
    drifts = DriftRows(mission.problem, rows.count - len(mission.problem.drifts))
    prices = np.zeros(6 + 3 * mission.problem.n_burns + rows.count)
    prices[-3] = 1.0
    pulled = adjoint(rows, lin, prices)
    nodes = mission.problem.burn_nodes
    np.testing.assert_allclose(
        pulled.by_mean[nodes[0], 3:] + own_errors(mission, lin, pulled.by_factor[nodes[0]]),
        -drifts.cones(lin)[0].values[0, 0, :3],
        rtol=1e-6,
    )


def own_errors(mission: Mission, lin: Linearisation, by_factor: Array) -> Array:
    """What the first burn's own columns of the factor add to a derivative by that burn."""
    slopes = mission.problem.execution_errors.jacobian(lin.iterate.burns)[0]
    return np.einsum("ic,icj->j", by_factor[3:, mission.problem.columns_of_burn(0)], slopes)


def test_values_are_reused_for_near_starts_only():
    mission, lin = at_plan_without(MISSED)
    drift = mission.problem.drifts[-1]
    branch, start = Branch(drift), start_of(lin, drift)
    known = branch(start)
    assert known.value > drift.required + FAR
    along = start.factor[:6, 0]
    assert branch(start._replace(mean=start.mean + 0.01 * along)).by is known.by
    away = start._replace(mean=start.mean + 5.0 * along)
    assert branch(away).value == pytest.approx(Branch(drift).anew(away).value, abs=1e-9)


def test_a_drift_follows_the_two_body_orbit():
    point = ("body.j2=0", "spacecraft.reflectivity_coefficient=0", "safety.drift_s=20000")
    mission = Mission.from_scenario(load_scenario(None, (*EXACT, MISSED, *point)))
    lin = mission.dynamics.linearise(mission.problem, planned().iterate)
    drift = mission.problem.drifts[0]
    start = start_of(lin, drift)
    mean, stm = Branch(drift).flown(start.mean)
    time, h = drift_duration_s(mission.scenario) / mission.units.time_s, 1e-5

    def end(state: Array) -> Array:
        def rate(_, x):
            return np.r_[x[3:], -x[:3] / np.linalg.norm(x[:3]) ** 3]

        return solve_ivp(rate, (0.0, time), state, "DOP853", rtol=1e-12, atol=1e-12).y[:, -1]

    assert mean[-1] == pytest.approx(end(start.mean), abs=1e-5)
    ends = [(end(start.mean + e) - end(start.mean - e)) / (2 * h) for e in h * np.eye(6)]
    np.testing.assert_allclose(stm[-1], np.array(ends).T, rtol=1e-4, atol=1e-3)


def test_derivatives_of_a_drift_are_those_of_casadi():
    mission, lin = at_plan_without("safety.cut_short=true")
    for drift in mission.problem.drifts[:2]:
        start, arcs = start_of(lin, drift), casadi_arcs(drift.flow)
        mean, stm = Branch(drift).flown(start.mean)
        x = ca.MX.sym("x", 6)
        ends = arcs.flow.mapaccum(drift.flow.arcs)(x, ca.DM(arcs.durations).T)
        some = [len(mean) // 2 - 1, len(mean) - 2]
        for node in some:
            end = ends[:, node]
            there = ca.Function("end", [x], [end, ca.jacobian(end, x)])(start.mean)
            np.testing.assert_allclose(mean[node + 1], np.array(there[0])[:, 0], atol=1e-8)
            scale = np.abs(stm[node + 1]).max()
            np.testing.assert_allclose(stm[node + 1], there[1], atol=1e-6 * scale)


def test_law_of_drift_matches_linear_flights():
    """Against draws of the linear law at the drift's nodes."""
    mission, lin = at_plan_without(MISSED)
    drift = mission.problem.drifts[0]
    start, branch = start_of(lin, drift), Branch(drift)
    mean, stm = branch.flown(start.mean)
    factor = stm @ start.factor
    root = np.linalg.cholesky(start.factor @ start.factor.T + 1e-18 * np.eye(6))
    draws = np.random.default_rng(3).standard_normal((50_000, 6)) @ root.T
    inside = np.zeros(len(draws), dtype=bool)
    for node in np.flatnonzero(np.linalg.norm(mean[:, :3], axis=1) < 3 * drift.keep_out[0].radius):
        position = mean[node, :3] + draws @ stm[node, :3].T
        inside |= np.linalg.norm(position, axis=1) < drift.keep_out[0].radius
    assert factor.shape[0] == len(mean)
    assert branch(start).value == pytest.approx(float(ndtri(1 - inside.mean())), abs=0.06)


def test_a_cut_burn_begins_between_missed_and_whole():
    mission, lin = at_plan_without("safety.cut_short=true", MISSED)
    missed, *cut = [start_of(lin, drift) for drift in mission.problem.drifts[: 1 + len(CUTS)]]
    node = mission.problem.burn_nodes[1]
    whole = Start(lin.iterate.mean[node], lin.factor[node])
    for share, start in zip(CUTS, cut, strict=True):
        for part, before, after in zip(start, missed, whole, strict=True):
            np.testing.assert_allclose(part, (1 - share) * before + share * after)


def test_missing_a_burn_of_no_size_changes_nothing():
    """Burn 3 of the plan has no size: its drift begins as the flight goes on."""
    mission, lin = at_plan_without(MISSED)
    node = mission.problem.burn_nodes[2]
    assert not lin.iterate.burns[2].any()
    start = start_of(lin, mission.problem.drifts[1])
    np.testing.assert_allclose(start.mean, lin.iterate.mean[node], atol=1e-9)
    np.testing.assert_allclose(start.factor, lin.factor[node], atol=1e-9)


def agrees_with_ipopt(scenario: Scenario, variant: str) -> float:
    """IPOPT starts near the plan: facets and optima are local, and others may be found from afar."""
    mission = Mission.from_scenario(scenario)
    ours = plan(mission, initial_guess.cold(mission))
    pushed = initial_guess.from_burns(mission, 1.05 * ours.burns_m_s)
    theirs = ipopt.plan(mission, pushed, variant=variant)
    assert theirs.status is ours.status is Status.CONVERGED
    assert theirs.total_dv_m_s == pytest.approx(ours.total_dv_m_s, rel=1e-5)
    return min(ours.final.margins[one.name].margin.min() for one in mission.problem.drifts)


UNIFORM = {"risk.allocation": "uniform", "risk.scope": "node", "polytopes.ball": "tangent"}
FIVE = (2, 3, 4, 6, 8)
BINDING = ("polytopes.ball='tangent'", MISSED, "safety.drift_radius_m=620")


def test_ipopt_finds_the_same_plan_with_drifts():
    least = agrees_with_ipopt(load_scenario(None, (COARSE, *BINDING)), "tuned")
    assert least == pytest.approx(0.0, abs=1e-5)


@nightly
@pytest.mark.parametrize("variant", ["printed", "shooting"])
def test_every_variant_of_ipopt_has_drifts(variant):
    agrees_with_ipopt(load_scenario(None, (COARSE, *BINDING)), variant)


@nightly
@pytest.mark.parametrize("number", FIVE)
def test_ipopt_agrees_on_random_scenarios_with_drifts(number):
    from experiments.solvers.cases import drawn

    agrees_with_ipopt(load_scenario(None, BINDING).replace(drawn(number)[1] | UNIFORM), "tuned")


def test_smaller_balls_lead_a_drift_out_of_one():
    mission, _ = at_plan_without(MISSED)
    *grown, last = Planner(mission).exact_stages(growing=True)
    radii = [spec.rows.problem.drifts[0].keep_out[0].radius for spec in (*grown, last)]
    assert [spec.name for spec in grown] == ["P2.grown"] * 3
    np.testing.assert_allclose(radii, np.array([*GROWN, 1.0]) * radii[-1])
