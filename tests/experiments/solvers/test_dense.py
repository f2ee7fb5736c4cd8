"""The dense search covers what it says, with flights that meet the boundary states."""

import numpy as np
import pytest

from experiments.solvers.dense import VOLUME, best_cells, first_burns, flown
from scp_recon.mission.mission import Mission
from scp_recon.scenario.load import load_scenario

pytestmark = pytest.mark.slow

COST = 1.7


@pytest.fixture(scope="module")
def mission():
    return Mission.from_scenario(load_scenario())


def test_pairs_of_burns_fill_their_box_evenly():
    """Of pairs drawn uniformly from a cube, those within the box are as many as its volume says.

    The same pairs have the moments of the spread ones.
    """
    spread = first_burns(COST, 2**13)
    sizes = np.linalg.norm(spread, axis=2)
    assert (sizes.sum(axis=1) <= COST).all()
    cube = np.random.default_rng(0).uniform(-COST, COST, (400_000, 2, 3))
    drawn = cube[np.linalg.norm(cube, axis=2).sum(axis=1) <= COST]
    assert len(drawn) / len(cube) * 2.0**6 == pytest.approx(VOLUME, rel=0.05)
    assert sizes.mean(axis=0) == pytest.approx(np.linalg.norm(drawn, axis=2).mean(axis=0), rel=0.02)
    assert (spread**2).mean(axis=0) == pytest.approx((drawn**2).mean(axis=0), rel=0.06)


def test_flights_meet_the_final_state(mission):
    """Every solved flight, flown again by the mission's own dynamics."""
    cost = 0.1 / mission.units.speed_m_s
    with np.errstate(all="ignore"):
        every, merit = flown(mission, first_burns(cost, 64))
    assert len(every) > 32
    spent = np.linalg.norm(every, axis=2).sum(axis=1)
    assert (merit >= spent).all()
    for burns in every:
        mean = mission.dynamics.rollout(mission.problem.initial_state, burns)
        assert mean[-1] == pytest.approx(mission.problem.final_state, abs=1e-4)


def test_chosen_flights_are_apart_best_first():
    every = np.random.default_rng(1).uniform(size=(50, 4, 3))
    merit = np.arange(50.0)[::-1]
    chosen = best_cells(every, merit, 0.8, 5)
    assert np.array_equal(chosen[0], every[-1])
    gaps = [np.linalg.norm(a[:2] - b[:2]) for i, a in enumerate(chosen) for b in chosen[:i]]
    assert len(chosen) > 1
    assert min(gaps) > 0.8
