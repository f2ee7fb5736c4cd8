"""Studies of feedback: gains of the last burns are kept, and sites are counted."""

import numpy as np
import pandas as pd
import pytest

from experiments.in_flight.sites import last_gains
from experiments.maps import counted
from formulations.problem.controls import Feedback


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
