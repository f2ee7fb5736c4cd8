"""From a body and a site to drafts of a scenario, from the longest window to the shortest."""

from __future__ import annotations

import tomllib
from collections.abc import Iterator
from dataclasses import replace
from datetime import timedelta

import numpy as np

from scp_recon.draft.draft import ROOM_DEG, Draft, GivenBody
from scp_recon.draft.flyby import burn_times, design_flyby, window_opens_s
from scp_recon.draft.text import draft_text
from scp_recon.errors import InputError
from scp_recon.mission.lighting import Lighting, lighting_slack
from scp_recon.mission.mission import rotation_of, site_of
from scp_recon.mission.states import sun_direction
from scp_recon.mission.survey import survey
from scp_recon.mission.windows import Window, all_windows, scan_step_s, whole_windows
from scp_recon.physics.frames import DAY_S
from scp_recon.physics.orbit import two_body
from scp_recon.scenario.load import validate_scenario
from scp_recon.scenario.schema import Scenario

HALF_WIDTHS_H = (4.0, 1.0, 0.5, 0.25)
"""Of the local solar time about the site's best hour, tried in turn; the first is 8 to 16 h."""
DARK_DEG = 80.0
"""Least incidence of a site that is not worth a visit."""
WINDOW_MIN_S, WINDOW_MAX_S = 120.0, 7200.0
"""Shorter ones show little; a pass leaves the limits of longer ones."""


def scenario_of(draft: Draft) -> Scenario:
    """The scenario that a draft's file holds."""
    return validate_scenario(tomllib.loads(draft_text(draft)))


def drafts(first: Draft) -> Iterator[Draft]:
    """Flybys of a site, designed: the whole window first, then shorter ones about its best hour.

    Args:
        first: with no design; its epoch is the earliest for the first burn.

    Raises:
        InputError: if the site has no window, be its limit raised to what the site allows.
    """
    scenario = scenario_of(first)
    period = abs(2.0 * np.pi / max(abs(rotation_of(scenario).rate), 1e-12))
    span = 0.0, 2.2 * period + window_opens_s(scenario.schedule)
    limit, best_hour = lit(scenario, span)
    known: set[Window] = set()
    for half in HALF_WIDTHS_H:
        hours = hours_about(best_hour, half)
        limited = replace(first, hours=hours, incidence_max_deg=limit)
        opens = window_opens_s(scenario.schedule)
        windows = [w.edges_s for w in survey(scenario_of(limited), span).windows]
        later = [
            w for w in windows if w[0] >= opens and WINDOW_MIN_S <= w[1] - w[0] <= WINDOW_MAX_S
        ]
        if not later or later[0] in known:
            continue
        known.add(later[0])
        moved = _moved(limited, float(round(later[0][0] - opens)))
        yield _designed(moved, opens)
    if not known:
        raise InputError(
            "--site",
            f"latitude {first.site_deg[0]:g} deg, longitude {first.site_deg[1]:g} deg",
            f"must have a lighting window of {WINDOW_MIN_S:g} to {WINDOW_MAX_S:g} s about the epoch",
        )


def hours_about(best_hour: float, half: float) -> tuple[float, float]:
    """Local solar times of a half-width about a site's best hour; the widest ones are about noon."""
    middle = 12.0 if half == HALF_WIDTHS_H[0] else best_hour
    return max(0.0, round(middle - half, 2)), min(24.0, round(middle + half, 2))


def lit(scenario: Scenario, span: Window) -> tuple[float, float]:
    """Limit of incidence in deg, raised where a site is never in it by far, and its best hour.

    Args:
        scenario: site, body, Sun and the limit as a rule.
        span: seconds past its epoch.

    Raises:
        InputError: if the site is dark.
    """
    lighting = Lighting(
        site_of(scenario), rotation_of(scenario), lambda t: sun_direction(scenario, t)
    )
    looks = np.linspace(*span, 4000)
    incidence = np.rad2deg(lighting.incidence(looks))
    least, limit = float(incidence.min()), scenario.observation.incidence_max_deg
    if least > DARK_DEG:
        raise InputError(
            "--site",
            f"a least incidence of {least:.1f} deg",
            f"must be lit at the epoch, at {DARK_DEG:g} deg or less: take another site or date",
        )
    at = looks[np.array([int(np.argmin(incidence))])]
    return max(limit, float(np.ceil(least + ROOM_DEG))), float(lighting.local_solar_time(at)[0])


def _moved(draft: Draft, shift_s: float) -> Draft:
    """The draft with a later epoch, and what a given body has become by then."""
    epoch = draft.epoch + timedelta(seconds=shift_s)
    if (body := draft.given) is None:
        return replace(draft, epoch=epoch)
    motion = two_body(body.position_km, body.velocity_km_s, (0.0, shift_s))
    around = motion(np.array([shift_s - 1.0, shift_s, shift_s + 1.0]))
    velocity = 0.5 * (around[2] - around[0])
    turned = body.meridian_deg + 360.0 * shift_s / (3600.0 * body.period_h)
    given = GivenBody(
        body.gm_m3_s2,
        body.radius_m,
        body.period_h,
        body.pole_deg,
        _rounded(around[1], 2),
        _rounded(velocity, 8),
        round(turned % 360.0, 6),
    )
    return replace(draft, epoch=epoch, given=given)


def _rounded(vector: np.ndarray, digits: int) -> tuple[float, float, float]:
    x, y, z = (round(float(value), digits) for value in vector)
    return x, y, z


def _designed(draft: Draft, opens: float) -> Draft:
    """The draft with its flyby through the window that opens about a time."""
    scenario = scenario_of(draft)
    rotation = rotation_of(scenario)
    lighting = Lighting(site_of(scenario), rotation, lambda t: sun_direction(scenario, t))
    slack = lighting_slack(scenario.observation, lighting.incidence, lighting.local_solar_time)
    search = 0.0, opens + WINDOW_MAX_S + DAY_S
    found = all_windows(slack, search, scan_step_s(rotation.rate, search))
    window = min(whole_windows(found, search), key=lambda w: abs(w[0] - opens))
    flight = 0.0, burn_times(window, scenario.schedule)[-1]
    alone = whole_windows(found, flight)[0] == window
    design = design_flyby(scenario, window)
    return replace(draft, design=design, window_s=None if alone else window)
