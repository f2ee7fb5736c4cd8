"""Between nodes flights are known to the second, and nodes are added where they touch a limit."""

import numpy as np
import pytest

from scp_recon.mission.constraints import SAFETY
from scp_recon.mission.mission import Mission
from scp_recon.monte_carlo.limits import joint_margins
from scp_recon.monte_carlo.sampling import Flyer
from scp_recon.monte_carlo.whole_flight import (
    SAMPLE_STEP_S,
    SampledFlights,
    kept_flights,
)
from scp_recon.planning import initial_guess
from scp_recon.planning.plan import Plan
from scp_recon.planning.planner import plan
from tests.scp_recon.certification.support import mission_of

pytestmark = pytest.mark.slow

FLIGHTS, SEED = 200, 3
CHANGES = {
    "observation.window_s": [13300.0, 18000.0],
    "observation.emission_max_deg": 40.0,
    "grid.step_max_s": 9000.0,
}
"""Emission is largest in the middle of the window, whose edges alone are nodes."""


@pytest.fixture(scope="module")
def sparse() -> Plan:
    mission = Mission.from_scenario(mission_of("node", 0.9).scenario.replace(CHANGES))
    return plan(mission, initial_guess.cold(mission))


def test_violations_between_nodes_are_found(sparse):
    """Against the same flights sampled every second of the window."""
    mission, burns = sparse.mission, sparse.burns_m_s
    told: list[int] = []
    whole = Mission.from_scenario(mission.scenario.replace({"risk.scope": "flight"}))
    kept = kept_flights(whole, burns, FLIGHTS, SEED, told.append)
    assert told == [FLIGHTS]
    flights = SampledFlights(mission, burns)
    judged = flights.judged(flights.draws(SEED, 0)[:FLIGHTS]).kept
    worst = kept_flights(mission, burns, FLIGHTS, SEED)
    assert mission.observed_s is not None
    first, last = mission.observed_s
    nodes = mission.times_s[mission.window_nodes]
    seconds = np.union1d(np.arange(np.ceil(first), last), nodes)
    flown = Flyer(mission, burns).fly_block(seconds, 0, flights=FLIGHTS, seed=SEED)
    holds = {
        name: margin >= 0.0
        for name, margin in joint_margins(mission, seconds, flown.states[..., :3]).items()
    }
    at = np.isin(seconds, nodes)
    every = np.logical_and.reduce(list(holds.values()))
    at_nodes, throughout = every[at].all(axis=0).sum(), every.all(axis=0).sum()
    assert throughout < at_nodes - 3
    assert judged[SAFETY][1].all()  # so that the window alone decides
    # A flight may touch a limit for less than a second.
    assert kept[:2] == pytest.approx((at_nodes, throughout), abs=1)
    for name, held in holds.items():
        counts = judged[name][1].sum(axis=1)
        np.testing.assert_array_equal(counts[np.isin(judged[name][0], nodes)], held[at].sum(axis=1))
        assert counts.min() == pytest.approx(held.sum(axis=1).min(), abs=1)
    seen = [judged[name] for name in holds]
    assert worst[:2] == (
        min(those[np.isin(times, nodes)].sum(axis=1).min() for times, those in seen),
        min(those.sum(axis=1).min() for _, those in seen),
    )
    lost = every[at].all(axis=0) & ~every.all(axis=0)
    broken = seconds[~every[:, lost].all(axis=1)]
    assert np.abs(kept.touched_s[:, None] - broken).min(axis=1).max() <= 1.0
    assert np.abs(broken[:, None] - kept.touched_s).min(axis=1).max() <= 0.5 * SAMPLE_STEP_S
