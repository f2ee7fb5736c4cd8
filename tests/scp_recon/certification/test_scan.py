"""Between nodes flights are known to the second, and nodes are added where they touch a limit."""

import numpy as np
import pytest

from scp_recon.mission.constraints import SAFETY
from scp_recon.mission.mission import Mission
from scp_recon.monte_carlo.observation_time import joint_margins
from scp_recon.monte_carlo.sampling import fly_block
from scp_recon.monte_carlo.whole_flight import LOOK_S, KeptFlights, kept_flights
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


@pytest.fixture(scope="module")
def kept(sparse) -> KeptFlights:
    """As flights that are to keep everything."""
    whole = Mission.from_scenario(sparse.mission.scenario.replace({"risk.scope": "flight"}))
    told: list[int] = []
    found = kept_flights(whole, sparse.burns_m_s, FLIGHTS, SEED, told.append)
    assert told == sorted(set(told))
    assert told[-1] == FLIGHTS
    return found


def test_violations_between_nodes_are_found(sparse, kept):
    """Against the same flights looked at every second of the window."""
    mission = sparse.mission
    assert mission.observed_s is not None
    first, last = mission.observed_s
    nodes = mission.times_s[mission.window_nodes]
    seconds = np.union1d(np.arange(np.ceil(first), last), nodes)
    flown = fly_block(mission, sparse.burns_m_s, seconds, 0, flights=FLIGHTS, seed=SEED)
    holds = {
        name: margin >= 0.0
        for name, margin in joint_margins(mission, seconds, flown.states[..., :3]).items()
    }
    at = np.isin(seconds, nodes)
    every = np.logical_and.reduce(list(holds.values()))
    whole_at_nodes, whole = every[at].all(axis=0).sum(), every.all(axis=0).sum()
    assert whole < whole_at_nodes - 3
    assert kept.throughout[SAFETY] == FLIGHTS  # so that the window alone decides
    # A flight may touch a limit for less than a second.
    assert (kept.whole_at_nodes, kept.whole) == pytest.approx((whole_at_nodes, whole), abs=1)
    for name, held in holds.items():
        np.testing.assert_array_equal(kept.at_nodes[name], held[at].sum(axis=1))
        assert kept.throughout[name] == pytest.approx(held.sum(axis=1).min(), abs=1)
    lost = every[at].all(axis=0) & ~every.all(axis=0)
    broken = seconds[~every[:, lost].all(axis=1)]
    assert np.abs(kept.touched_s[:, None] - broken).min(axis=1).max() <= 1.0
    assert np.abs(broken[:, None] - kept.touched_s).min(axis=1).max() <= 0.5 * LOOK_S
