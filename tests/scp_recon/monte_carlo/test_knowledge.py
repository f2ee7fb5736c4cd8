"""Flights with parameters of their own: their streams, and the normal law against them."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from scipy.stats import binom

import scp_recon
from formulations.rows.drift import start_of
from formulations.rows.exact_flight import FLIGHT
from scp_recon.mission.constraints import Miss
from scp_recon.mission.mission import Mission
from scp_recon.mission.windows import SCAN_STEP_S, each_window
from scp_recon.monte_carlo.drifts import fly_drifts
from scp_recon.monte_carlo.limits import SCIENCE, joint_margins
from scp_recon.monte_carlo.sampling import Flyer
from scp_recon.monte_carlo.strata import Law
from scp_recon.monte_carlo.whole_flight import PARTS, SampledFlights, kept_flights, sample_times
from scp_recon.planning.initial_guess import from_burns
from scp_recon.scenario.load import load_scenario
from scp_recon.scenario.schema import Scenario
from tests.helpers import nightly
from tests.scp_recon.mission.test_knowledge import BURNS, COARSE, EVERYTHING
from tests.scp_recon.support import COMPANION, fly_few, from_cold

pytestmark = pytest.mark.slow

CERTAIN = {"uncertainty": {"initial_sigma_fraction": 0.0, "execution_error": 0.0}}
ALONE: dict[str, Any] = {
    "body.gm_m3_s2": 0.05,
    "body.j2": 0.004,
    "body.pole_ra_deg": 2.0,
    "body.pole_dec_deg": 2.0,
    "body.prime_meridian_deg": 1.0,
    "body.prime_meridian_rate_deg_day": 3.0,
    "spacecraft.reflectivity_coefficient": 0.2,
    "site.position_body_m": [4.0, 4.0, 4.0],
    "site.normal_body": [0.02, 0.02, 0.02],
    "body.companion.gm_m3_s2": 0.01,
    "body.companion.mean_anomaly_deg": 0.4,
}


def mission_with(changes: dict[str, Any]) -> Mission:
    return Mission.from_scenario(load_scenario().replace({**COARSE, **changes}))


def flights_of(mission: Mission) -> SampledFlights:
    return SampledFlights(mission, BURNS, times_s=mission.times_s[mission.window_nodes])


def law_of(mission: Mission) -> Law:
    lin = mission.dynamics.linearise(mission.problem, from_burns(mission, BURNS))
    return Law.of(mission, lin, is_whole=True)


@pytest.mark.parametrize("entry", ALONE)
def test_single_parameter_acts_on_flights_as_predicted(entry):
    """What flights see of each limit, less the mean, is the linear law's to 2 %, for small draws."""
    companion = {"body.companion": COMPANION} if ".companion." in entry else {}
    changes = {**companion, **CERTAIN, f"knowledge.{entry}": ALONE[entry]}
    mission = mission_with(changes)
    draws = 0.1 * Flyer(mission, BURNS, seed=3).draws(0)[:20]
    flown = Flyer(mission, BURNS).fly(mission.times_s, draws)
    lin = mission.dynamics.linearise(mission.problem, from_burns(mission, BURNS))
    mean, factor = lin.iterate.mean, lin.spread.factor
    known = draws[:, 6 : 6 + mission.uncertain.count]
    moved, off = 0.0, []
    for c in mission.problem.constraints:
        linear = mean[c.nodes, None, :3] + np.einsum("nic,mc->nmi", factor[c.nodes, :3], draws)
        if c.motion is not None:
            linear = c.motion.of_draws(linear, known)
        expected = c.region.inside(linear) - c.region.inside(mean[c.nodes, :3])[:, None]
        # The exact region of each flight, as `Mission.problem` of its own parameters has it.
        found = np.empty_like(expected)
        for flight in range(len(draws)):
            own = flown.mission.some_flights(flight)
            region = next(o.region for o in own.problem.constraints if o.name == c.name)
            at = flown.states[c.nodes, flight, :3] / mission.units.length_m
            found[:, flight] = region.inside(at) - c.region.inside(mean[c.nodes, :3])
        size = float(np.sqrt(np.mean(found**2)))
        off.append(float(np.sqrt(np.mean((found - expected) ** 2))))
        moved = max(moved, size)
    assert max(off) <= 0.02 * moved
    assert moved > 1e-7  # of 1 km: no parameter is without effect


def test_parameters_have_a_stream_of_their_own():
    """An uncertain site leaves every path as it is, and moves what is seen from it."""
    plain = mission_with({})
    site = mission_with({"knowledge.site.position_body_m": [2.0, 2.0, 2.0]})
    one, other = (Flyer(m, BURNS).fly_block(m.times_s, 1, flights=40) for m in (plain, site))
    assert np.array_equal(one.states, other.states)
    assert one.mission is plain
    assert other.mission.site.position_body.shape == (40, 3)


def test_limits_count_in_each_flights_own_window():
    """The window of each flight is searched for anew, and every sample in it judged by itself."""
    changes = {"knowledge.body.prime_meridian_deg": 2.0, "knowledge.body.pole_dec_deg": 1.0}
    mission = mission_with(changes)
    draws = Flyer(mission, BURNS, seed=7).draws(0)[:60]
    flown = Flyer(mission, BURNS).fly(sample_times(mission), draws)
    times, kept, planned = flown.times_s, list[bool](), list[bool]()
    for number in range(len(draws)):
        own, path = flown.mission.some_flights(number), flown.states[:, number, :3]
        limits = joint_margins(replace(own, nominal=None, deviation=None), times, path)
        holds = np.logical_and.reduce([margin >= 0.0 for margin in limits.values()])
        slack = own.scene.lighting.slack(mission.scenario.observation)
        windows = each_window(slack, (9000.0, 21_000.0), SCAN_STEP_S)
        first, last = min(windows, key=lambda w: abs(w[0] - mission.schedule.window_s[0]))
        kept.append(bool(holds[(times >= first) & (times <= last)].all()))
        first, last = mission.schedule.window_s
        planned.append(bool(holds[(times >= first) & (times <= last)].all()))
    judged = SampledFlights(mission, BURNS).judged(draws).kept
    found = np.logical_and.reduce([judged[name][1][::PARTS].all(axis=0) for name in SCIENCE])
    assert found.tolist() == kept
    assert kept != planned
    early, late = np.array(mission.edges.watched_s) - mission.observed_s
    assert (-early, late) == pytest.approx(3.0 * mission.edges.sigmas_s)
    given = mission.changed({"observation.window_s": [13_200.0, 16_400.0]})
    assert given.edges.sigmas_s is None
    assert given.edges.watched_s == given.observed_s


def test_flights_keep_limits_as_often_as_by_law():
    """With everything uncertain besides the errors of state and burns: 3,000 flights."""
    window = mission_with({}).schedule.window_s
    mission = mission_with({"knowledge": EVERYTHING, "observation.window_s": window})
    flights, law = flights_of(mission), law_of(mission)
    draws = np.concatenate([Flyer(mission, BURNS, seed=5).draws(block) for block in range(3)])
    by_law = law.margins(draws)[FLIGHT][0] >= 0.0
    flown = np.logical_and.reduce(
        [those.all(axis=0) for _, those in flights.judged(draws).kept.values()]
    )
    assert 0.05 < flown.mean() < 0.98
    assert np.mean(by_law != flown) < 0.02


@pytest.mark.parametrize("truth", ["harmonics", "polyhedron"])
def test_true_gravity_deviates_too(truth):
    changes = {**CERTAIN, "knowledge.body.gm_m3_s2": 0.05}
    mission = mission_with(changes)
    ends = mission.times_s[-1:]
    sizes = []
    for gravity in ("planner", truth):
        flown = Flyer(mission, BURNS, truth=gravity).fly_block(ends, 0, flights=12)
        sizes.append(flown.states[0, :, :3].std(axis=0))
    np.testing.assert_allclose(sizes[1], sizes[0], rtol=0.2)


def test_drifts_have_the_parameters_of_their_flights():
    """After the last burn is missed: the linear law of the drift's start and of its end."""
    changes = {**CERTAIN, "knowledge.body.gm_m3_s2": 0.05, "safety.missed_burns": 1}
    mission = mission_with({**changes, "safety.drift_s": 7200.0})
    config, (drift,) = Flyer(mission, BURNS), mission.problem.drifts[2:]
    lin = mission.dynamics.linearise(mission.problem, from_burns(mission, BURNS))
    assert start_of(lin, drift).factor.shape[0] == 7
    assert np.abs(start_of(lin, drift).factor[:6, 6]).max() > 1e-4
    (flown,) = fly_drifts(config, [Miss(4)], config.first_draws(30))
    assert flown.closest_m.std() > 0.0


def test_plan_with_everything_uncertain_is_verified(monkeypatch):
    fly_few(monkeypatch)
    scenario = load_scenario().replace({"knowledge": EVERYTHING})
    found = scp_recon.plan(scenario, facet_rounds=0)
    checked = scp_recon.verify(found)
    assert checked.ok, checked.failed
    plain = from_cold(Mission.from_scenario(load_scenario()))
    assert found.total_dv_m_s > plain.total_dv_m_s


def random_scenario(rng: np.random.Generator, kind: str) -> Scenario:
    """GM is uncertain by 3 to 10 %, and three other entries with it."""
    entries = rng.choice([e for e in ALONE if ".companion." not in e], size=3, replace=False)
    changes: dict[str, Any] = {
        f"knowledge.{e}": (np.array(ALONE[e]) * rng.uniform(1.0, 1.8)).tolist() for e in entries
    }
    changes["knowledge.body.gm_m3_s2"] = float(rng.uniform(0.15, 0.5))
    changes["risk.p_chance"] = float(rng.uniform(0.7, 0.9))
    changes["observation.site_distance_max_m"] = float(rng.uniform(740, 790))
    if kind == "certified":
        changes |= {"risk.allocation": "exact", "risk.scope": "flight"}
    return load_scenario().replace(changes)


@nightly
@pytest.mark.parametrize("kind", ["uniform", "certified"])
@pytest.mark.parametrize("seed", range(20))
def test_random_scenarios_hold_their_probability(kind, seed):
    """10,000 fresh flights each: no more outside than a binomial test at 0.1 % allows.

    Scenarios are drawn until there is a plan, whose flights keep the limits by over 2 % more often if
    they have the scenario's parameters.
    """
    rng = np.random.default_rng(seed)
    for _ in range(10):
        found = scp_recon.plan(random_scenario(rng, kind))
        mission, burns, own = found.mission, found.burns_m_s, 900 + seed
        known = Mission.from_scenario(mission.scenario.replace({"knowledge": None}))
        kept, without = (
            kept_flights(SampledFlights(one, burns, seed=own), 10_000).throughout
            for one in (mission, known)
        )
        if found.status.name == "CONVERGED" and without - kept > 200:
            break
    else:
        pytest.fail("no scenario in which the parameters matter")
    assert binom.cdf(kept, 10_000, mission.scenario.risk.p_chance) >= 1e-3
