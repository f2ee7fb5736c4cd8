"""A mission of another size is the same mission: one plan and one verdict in its own units."""

import numpy as np
import pytest

import scp_recon as sr
from formulations.arrays import Array
from scp_recon.scenario.load import load_scenario
from scp_recon.scenario.schema import Scenario
from tests.helpers import usually
from tests.scp_recon.support import file_of, fly_few

pytestmark = pytest.mark.slow

LENGTHS = ("_m", "_m_s", "srp_area_m2")
"""Endings of entries that grow with the size: pressure accelerates by area over mass."""
SCALES = (500.0, 1e-2, 1e-1, 10.0, 1e2, 1e3, 1e4)


def scaled(size: float) -> Scenario:
    """The default scenario with lengths and speeds times `size`, and GM times its cube: times stay."""
    scenario = load_scenario()
    changes: dict[str, object] = {
        "body.gm_m3_s2": scenario.body.gm_m3_s2 * size**3,
        "site.position_body_m": [size * x for x in scenario.site.position_body_m],
    }
    for table, entries in scenario.model_dump(exclude_none=True).items():
        for entry, value in entries.items() if isinstance(entries, dict) else ():
            if entry.endswith(LENGTHS) and np.size(value) and not isinstance(value, str):
                grown = size * np.array(value)
                changes[f"{table}.{entry}"] = grown.tolist()
    changes["body.radii_m"] = None
    return file_of(scenario, changes, name="Another")


@pytest.fixture(scope="module")
def burns() -> Array:
    """Of the default mission in the same words."""
    return sr.plan(scaled(1.0), certify=False).burns_m_s


@pytest.mark.parametrize("size", usually(SCALES, 2))
def test_plan_is_independent_of_mission_scale(burns, size, monkeypatch):
    fly_few(monkeypatch)
    plan = sr.plan(scaled(size), certify=False)
    assert plan.burns_m_s / size == pytest.approx(burns, rel=1e-6, abs=1e-8)
    assert sr.verify(plan).failed == []
