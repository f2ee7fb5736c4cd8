import numpy as np
import pytest

pytest.importorskip("Basilisk", reason="needs the extra [sim]")

from experiments.spacecraft import timing_rules
from experiments.spacecraft.timing_rules import (
    SETTLED,
    claim,
    dark_charge,
    measure_recharge,
    measure_slew,
    rules,
)
from scp_recon.simulation.panels import SolarArray, irradiance
from tests.helpers import nightly

pytestmark = pytest.mark.slow


@nightly
def test_a_half_turn_takes_at_least_the_limited_rate_and_settles(mission, vehicle, monkeypatch):
    monkeypatch.setattr(timing_rules, "SLEW_S", 1500.0)
    slew = measure_slew(mission, vehicle, 0, 2)
    settling_s = [slew[column] for column in SETTLED.values()]
    assert settling_s == sorted(settling_s)
    assert settling_s[0] > 180.0 / 0.4
    assert settling_s[-1] < 1200.0
    assert slew["steady_rms_deg"] < 0.2


def test_a_recharge_takes_what_the_power_left_over_gives(mission, vehicle, monkeypatch):
    """Batteries an eighth as large, so that the flight is short."""
    monkeypatch.setattr(timing_rules, "RECHARGE_S", 300.0)
    battery = vehicle.battery.model_copy(update={"capacity_wh": 5.0})
    small = vehicle.model_copy(update={"battery": battery})
    most = np.linalg.norm(SolarArray.of(vehicle, irradiance(mission.scenario)).best_direction())
    net = most - vehicle.loads.quiescent_w
    expected = 3600.0 * 10.0 / battery.efficiency / net
    assert measure_recharge(mission, small, 0) == pytest.approx(expected, abs=3.0)
    monkeypatch.setattr(timing_rules, "RECHARGE_S", 100.0)
    assert measure_recharge(mission, small, 0) == np.inf


def test_a_rule_holds_if_the_worst_is_within_it(mission, vehicle):
    slews = [dict(zip(SETTLED.values(), (t - 20.0, t - 10.0, t), strict=True)) for t in (900, 1801)]
    found = rules(mission, vehicle, slews, (1200.0, 1201.0))
    assert [rule["holds"] for rule in found] == [False, True, True, False]
    assert claim(found[0])[1:] == ("30 min", "30.0 min", False)
    # 115 W for half an hour out of 80 Wh at 0.96.
    assert dark_charge(vehicle) == pytest.approx(1.0 - 57.5 / 0.96 / 80.0)
