"""The paper's table: a window under a still Sun."""

import numpy as np
import pytest

from experiments.observation_table import still_sun_window_s
from scp_recon.physics import geometry


def test_still_sun_window_follows_from_rotation_alone(mission):
    """The incidence's cosine then is a sinusoid of the body's turning alone."""
    pole, sun = mission.rotation.pole, mission.sun_direction(0.0)
    normal = geometry.track(mission.site, mission.rotation, np.zeros(1)).normal[0]
    along, off = (np.array([v @ pole, np.sqrt(1.0 - (v @ pole) ** 2)]) for v in (normal, sun))
    limit = np.cos(np.deg2rad(mission.scenario.observation.incidence_max_deg))
    turned = 2.0 * np.arccos((limit - along[0] * off[0]) / (along[1] * off[1]))
    rate = np.deg2rad(mission.scenario.body.prime_meridian_rate_deg_day) / 86_400.0
    assert still_sun_window_s(mission) == pytest.approx(turned / rate, abs=0.1)
