"""Checks for stale entries, which follow from others and were left as a packaged scenario has them.

Entries are compared by value, so that it makes no difference whether they were inherited, copied from
the base by hand, or left alone by an override.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from operator import attrgetter

import numpy as np

from scp_recon.errors import InputError
from scp_recon.mission.scene import Scene
from scp_recon.scenario.dependencies import PLACE, STATE
from scp_recon.scenario.fields import ScenarioWarning
from scp_recon.scenario.load import base_names, packaged_scenario
from scp_recon.scenario.resolution.agreement import angle_deg
from scp_recon.scenario.schema import Scenario

SUN_MOVED_DEG = 0.01
"""Below it another epoch may keep the Sun: a quarter of an hour, of a body at 1 au."""
SITE_MOVED_DEG = 1.0
"""As seen from the body's centre; below it another position may be on the same slope."""
OF_ONE_BODY = "body.gm_m3_s2", "body.j2", STATE[0]
"""What no two bodies share."""


def stale_entries(scene: Scene) -> Iterator[ScenarioWarning]:
    """Refuse the Sun of another epoch and the normal of another site; warn of another body's figures.

    Another epoch is one at which the Sun has moved by 0.01 deg, another site one 1 deg away as seen
    from the centre; figures are GM, J2 and the Sun's position under another name. Held against it are
    the file that is named as base, the file itself where `--set` changes it, and every packaged one.

    Raises:
        InputError: naming the entry that has to be given as well.
    """
    here = scene.scenario
    for base in map(packaged_scenario, base_names()):
        _refuse_other_sun(base, here)
        _refuse_other_normal(base, here)
        if here.body.name != base.body.name:
            for entry in _kept(base, here, OF_ONE_BODY):
                yield ScenarioWarning.of(
                    entry,
                    f"that of {base.body.name}",
                    f"the body is {here.body.name}: give its own",
                )


def _kept(base: Scenario, here: Scenario, entries: tuple[str, ...]) -> list[str]:
    """Those of some entries that are the same in both."""
    return [entry for entry in entries if attrgetter(entry)(base) == attrgetter(entry)(here)]


def _refuse_other_sun(base: Scenario, here: Scenario) -> None:
    kept = _kept(base, here, STATE)
    before, after = base.epoch.tdb, here.epoch.tdb
    position, velocity = np.array(base.sun.body_position_km), np.array(base.sun.body_velocity_km_s)
    # How fast the Sun's direction turns as seen from the body, in rad/s: |r x v| / r^2.
    rate = float(np.linalg.norm(np.cross(position, velocity)) / (position @ position))
    moved = math.degrees(abs((after - before).total_seconds()) * rate)
    if kept and moved > SUN_MOVED_DEG:
        was, now = (moment.isoformat(timespec="seconds") for moment in (before, after))
        # The mean motion says nothing beyond half a turn.
        turn = f"{moved:.3g} deg" if moved < 180.0 else "more than half a turn"
        raise InputError(
            kept[0],
            f"the Sun of {was} TDB at the epoch {now} TDB",
            f"must be given for the new epoch: the Sun has moved by {turn} about the body",
        )


def _refuse_other_normal(base: Scenario, here: Scenario) -> None:
    normal = PLACE[1]
    moved = angle_deg(base.site.position_body_m, here.site.position_body_m)
    if moved > SITE_MOVED_DEG and _kept(base, here, (normal,)):
        raise InputError(
            normal,
            f"the normal of a site {moved:.1f} deg away",
            "must be given with site.position_body_m: the other site has a slope of its own",
        )
