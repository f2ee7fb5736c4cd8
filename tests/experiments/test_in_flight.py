"""Studies of feedback: targeting gains do what they say, and claims judge what is there."""

from dataclasses import replace

import numpy as np
import pandas as pd
import pytest

from experiments.in_flight import feedback
from experiments.in_flight.sites import last_gains
from experiments.maps import counted
from experiments.plans import FLIGHT
from formulations.problem.feedback import Feedback
from scp_recon.mission.mission import Mission
from scp_recon.planning import initial_guess
from scp_recon.results.policy import policy_of, transition
from scp_recon.scenario.load import load_scenario


def test_whole_gain_targets_the_planned_position():
    """Carried to the burn, corrected, and carried on, what is estimated leaves no deviation there."""
    changes = FLIGHT | feedback.measured(lead_s=feedback.LEAD_S) | {"risk.p_chance": 0.9}
    mission = Mission.from_scenario(load_scenario().replace(changes))
    burns = [[-0.01, 0.045, 0.02], [-0.007, 0.026, -0.007], [0.0] * 3, [-0.009, 0.035, 0.014]]
    iterate, problem = initial_guess.from_burns(mission, np.array(burns)), mission.problem
    lin = mission.dynamics.linearise(
        problem, replace(iterate, gains=np.zeros(problem.feedback.size))
    )
    node, cut_off = int(problem.burn_nodes[1]), int(problem.feedback.cut_offs[0])
    end = int(mission.window_nodes[3])
    (one,) = policy_of(mission, feedback.targeted(lin, end)(1.0))
    (part,) = policy_of(mission, feedback.targeted(lin, end)(0.25))
    np.testing.assert_allclose(part.gains, 0.25 * one.gains, rtol=1e-9)
    gain = one.gains[0] * mission.units.state / mission.units.speed_m_s
    before, after = (transition(lin.arcs.stm, *ends) for ends in ((cut_off, node), (node, end)))
    left = after @ (before + np.vstack([np.zeros((3, 6)), gain]))
    size = np.abs(after @ before)[:3].max()
    np.testing.assert_allclose(left[:3] / size, 0.0, atol=1e-7)


@pytest.mark.parametrize("left", [3, 2, 1])
def test_last_burns_keep_gains_on_later_knowledge(left):
    def of(burns: int) -> Feedback:
        numbers = np.arange(burns)
        return Feedback(1 + numbers, numbers, np.array([np.eye(6)] * burns), "dv99", 0.9)

    gains = np.random.default_rng(left).normal(size=of(3).size)
    kept, gone = last_gains(gains, left), 3 - left
    assert kept.shape == (of(left).size,)
    for j in range(left):
        whole = of(3).of_burn(gains, j + gone)
        assert np.array_equal(of(left).of_burn(kept, j), whole[:, 6 * gone :])


def test_sites_are_counted_by_how_reached():
    alone = {"open": True, "corrected": True, "dv99_m_s": 0.1, "whole_flight": 0.91}
    more = {"open": False, "corrected": True, "dv99_m_s": 0.3, "whole_flight": 0.88}
    rows = pd.DataFrame([alone, more, {"open": False, "corrected": False}])
    row = counted(rows)
    assert (row["sites"], row["open"], row["more"]) == (3, 1, 1)
    assert row["open_dv99_m_s_max"] == 0.1
    assert row["more_dv99_m_s_min"] == 0.3
    assert row["more_whole_flight_min"] == 0.88
    assert np.isnan(counted(rows[2:])["open_dv99_m_s_min"])
