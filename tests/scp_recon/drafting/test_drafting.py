"""Drafts of a scenario: legal by the schedule's rules, on the home orbit, and said line by line."""

from datetime import datetime

import numpy as np
import pytest

from scp_recon.drafting.draft import Draft, GivenBody, draft_text, drafts, scenario_of
from scp_recon.drafting.flyby import HOME_RADII, burn_times
from scp_recon.errors import InputError
from scp_recon.mission.mission import Mission
from scp_recon.mission.schedule import legal_burns
from scp_recon.physics.two_body import two_body
from scp_recon.scenario.schema import Scenario

EPOCH = datetime(2020, 1, 21, 20, 33, 17)
FAST = GivenBody(
    30.0, 448.0, 3.1, (96.4, -66.4), (1.5e8, 9e7, 4e7), (-13.5, 21.0, 9.0), 0.0
)  # fmt: skip


def first(site: tuple[float, float], body: GivenBody | None = None) -> Draft:
    if body is None:
        return Draft("mine", "Bennu", None, site, EPOCH, 290.0)
    return Draft("mine", "Stone", body, site, EPOCH, body.radius_m)


def assert_on_the_terminator(scenario: Scenario) -> None:
    """Boundary states are on a circle in its plane, at two-body speed."""
    radius = HOME_RADII * scenario.body.reference_radius_m
    boundary = scenario.boundary
    for which in ("initial", "final"):
        position = np.array(getattr(boundary, f"{which}_position_m"))
        velocity = np.array(getattr(boundary, f"{which}_velocity_m_s"))
        assert abs(position[0]) < 1e-2  # X is towards the Sun
        assert abs(velocity[0]) < 1e-6
        assert np.linalg.norm(position) == pytest.approx(radius, rel=1e-5)
        assert velocity @ velocity == pytest.approx(scenario.body.gm_m3_s2 / radius, rel=1e-4)
        assert abs(position @ velocity) < 1e-5 * radius * np.linalg.norm(velocity)


def assert_assumed(mission: Mission) -> None:
    """Navigation is a sphere of a hundredth of distance and speed, and called an assumption."""
    factor, state = mission.initial_factor, mission.initial_state
    for part in (slice(0, 3), slice(3, 6)):
        covariance = factor[part, part] @ factor[part, part].T
        sigma = float(np.sqrt(covariance[0, 0]))
        np.testing.assert_allclose(covariance, sigma**2 * np.eye(3), atol=1e-9 * sigma**2)
        assert np.sqrt(3.0) * sigma == pytest.approx(0.01 * np.linalg.norm(state[part]), rel=0.35)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("site", "body"), [((55.9, 41.8), None), ((-30.0, 200.0), None), ((20.0, 0.0), FAST)]
)
def test_a_draft_is_a_legal_mission(site, body):
    """Its window is the one it was designed for, and its burns have room about it."""
    draft = next(drafts(first(site, body)))
    scenario = scenario_of(draft)
    mission = Mission.from_scenario(scenario)
    assert scenario.epoch.tdb >= EPOCH
    window = mission.schedule.window_s
    assert draft.design.times_s == scenario.burns.times_s
    assert scenario.burns.times_s == pytest.approx(burn_times(window, scenario.schedule), abs=2.0)
    legal = legal_burns(window, scenario.duration_s, 1, 2, scenario.schedule, (0.0, 0.0))
    for time, (early, late) in zip(scenario.burns.times_s[1:3], legal[1:3], strict=True):
        assert early + 400.0 <= time <= late - 400.0
    assert_on_the_terminator(scenario)
    assert_assumed(mission)
    # The body turns fast enough for a window before this one: the file has to name its own.
    assert (scenario.observation.window_s is not None) == (body is FAST)


def test_given_body_moves_and_turns_with_the_epoch():
    draft = next(drafts(first((20.0, 0.0), FAST)))
    shift = (draft.epoch - EPOCH).total_seconds()
    assert shift > 0.0
    moved = two_body(FAST.position_km, FAST.velocity_km_s, (0.0, shift))(shift)
    np.testing.assert_allclose(draft.given.position_km, moved, atol=0.01)
    step = two_body(draft.given.position_km, draft.given.velocity_km_s, (-shift, 0.0))(-shift)
    np.testing.assert_allclose(step, FAST.position_km, atol=1.0)
    turned = 360.0 * shift / (3600.0 * FAST.period_h)
    assert (draft.given.meridian_deg - turned) % 360.0 == pytest.approx(0.0, abs=1e-3)


def test_every_entry_has_a_comment():
    for body in (None, FAST):
        text = draft_text(next(drafts(first((20.0, 0.0), body))))
        entries = [line for line in text.splitlines() if " = " in line]
        assert len(entries) > 35
        assert all(len(line.split("  # ")[1]) > 3 for line in entries)


def test_a_site_in_the_dark_is_refused():
    with pytest.raises(InputError, match="must be lit"):
        next(drafts(Draft("x", "Eros", None, (-70.0, 0.0), datetime(2021, 3, 4), 16_000.0)))
