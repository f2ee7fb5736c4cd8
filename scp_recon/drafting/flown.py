"""Draft a scenario from an existing trajectory: window, boundary states, legal burns."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from datetime import datetime

import numpy as np

from formulations.arrays import Array
from scp_recon.drafting.draft import (
    WINDOW_MAX_S,
    WINDOW_MIN_S,
    Draft,
    Entry,
    Tables,
    scenario_of,
    under_limits,
)
from scp_recon.drafting.flyby import SLACK_S
from scp_recon.errors import InputError, option
from scp_recon.mission.schedule import legal_burns
from scp_recon.mission.windows import Window
from scp_recon.scenario.fields import ScenarioWarning
from scp_recon.scenario.schema import Scenario

BEFORE, AFTER = 1, 2
"""Burns between the first one and the window, and after it."""


@dataclass(frozen=True, eq=False)
class Track:
    """A trajectory about a body, J2000, body-centred, SI."""

    epoch: datetime
    """TDB of its first state, which is that before the first burn."""
    times_s: Array
    """Past it, ascending from 0; twice the same at a burn, shape (n,)."""
    states: Array
    """Shape (n, 6)."""
    source: str
    """Name of its file, for comments."""
    doubts: tuple[ScenarioWarning, ...] = ()
    """Warnings about it."""
    entry: str = ""
    """Option and file that it is from."""
    unit: str = "km"
    """Unit of its file's positions, and by the second that of its velocities."""
    where: tuple[str, ...] = ()
    """Where each state stands in its file; empty without lines."""

    @property
    def duration_s(self) -> float:
        """Time from the first state to the last, s."""
        return float(self.times_s[-1])


def flown_draft(first: Draft, known: Tables, track: Track) -> Draft:
    """Draft a flyby from a trajectory's first state to its last.

    Site and reference radius are those of `first`, and `known` has the tables of body and Sun.

    Raises:
        InputError: if no lighting window of the site leaves room for the schedule's burns.
    """
    span = 0.0, track.duration_s
    ends: dict[str, Sequence[Entry]] = {
        "epoch": [("tdb", track.epoch.isoformat(), f"TDB of the first burn; {track.source}")],
        "boundary": _boundary(track),
        "burns": _burns(track, span),
    }
    found = replace(first, epoch=track.epoch, instead={**known, **ends})
    seen: list[Window] = []
    for draft, windows in under_limits(found, span):
        scenario = scenario_of(draft)
        for number, window in enumerate(windows):
            times = _legal_times(scenario, window)
            if times is not None and WINDOW_MIN_S <= window[1] - window[0] <= WINDOW_MAX_S:
                tables = {**found.instead, "burns": _burns(track, times)}
                return replace(draft, window_s=window if number else None, instead=tables)
        seen += windows
    given = ", ".join(f"{a:.0f} to {b:.0f} s" for a, b in seen) or "none"
    raise InputError(
        option("site"),
        f"lighting windows {given}, in the {track.duration_s:.0f} s of the trajectory",
        f"must have one of {WINDOW_MIN_S:g} to {WINDOW_MAX_S:g} s with room for {BEFORE} burn between "
        f"the first one and it and {AFTER} after it by the schedule's rules: begin earlier or "
        "end later",
    )


def _legal_times(scenario: Scenario, window: Window) -> tuple[float, ...] | None:
    """Latest legal times before the window and earliest after it, with margin; or None."""
    duration, rules = scenario.duration_s, scenario.schedule
    intervals = legal_burns(window, duration, BEFORE, AFTER, rules)
    if any(early > late for early, late in intervals[1:]):
        return None
    (early, late), (soon, far) = intervals[1], intervals[2]
    before, after = max(early, late - SLACK_S), min(soon + SLACK_S, far)
    return 0.0, float(np.floor(before)), float(np.ceil(after)), duration


def _boundary(track: Track) -> list[Entry]:
    entries: list[Entry] = [("frame", "j2000", "as the trajectory is given")]
    for which, state in (("initial", track.states[0]), ("final", track.states[-1])):
        when = "before the first burn" if which == "initial" else "after the last burn"
        entries += [
            (f"{which}_position_m", state[:3].tolist(), f"m, body-centred; {track.source}, {when}"),
            (f"{which}_velocity_m_s", state[3:].tolist(), f"m/s; {track.source}, {when}"),
        ]
    return entries


def _burns(track: Track, times: Sequence[float]) -> list[Entry]:
    speed = float(np.linalg.norm(track.states[:, 3:], axis=1).max())
    return [
        (
            "times_s",
            list(times),
            "s past epoch.tdb; the trajectory's ends, and about the window by the schedule's rules",
        ),
        ("dv_max_m_s", float(f"{speed:.3g}"), "m/s, largest burn; the trajectory's largest speed"),
    ]


def start_table(track: Track) -> Array:
    """The trajectory as a table that a plan starts from: t, x, y, z, vx, vy, vz, SI, shape (n, 7).

    The planner has its own states at the ends: of two states at one end, only the inner one is
    kept.
    """
    inner = (track.times_s > 0.0) & (track.times_s < track.duration_s)
    first = int(np.flatnonzero(track.times_s == 0.0)[-1])
    last = int(np.searchsorted(track.times_s, track.duration_s))
    chosen = np.unique([first, *np.flatnonzero(inner), last])
    return np.column_stack([track.times_s, track.states])[chosen]


def start_csv(track: Track, columns: Sequence[str]) -> str:
    """The trajectory as a CSV file for `--init`."""
    lines = [",".join(columns), *(",".join(map(repr, row)) for row in start_table(track).tolist())]
    about = f"# {track.source}; J2000, body-centred; t_s = 0 is {track.epoch.isoformat()} TDB"
    return "\n".join([about, *lines]) + "\n"
