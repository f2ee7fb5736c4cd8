"""Draft scenarios for a body and a site: flybys, longest window first, and their files.

A draft may also be made from an existing trajectory: window, boundary states, legal burns.
"""

from __future__ import annotations

import json
import re
import tomllib
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from datetime import datetime, timedelta
from importlib.resources import files
from string import Template

import numpy as np

from formulations.arrays import Array
from scp_recon.bodies.catalogue import DAY_S
from scp_recon.drafting.flyby import (
    HOME_RADII,
    SLACK_S,
    Design,
    burn_times,
    design_flyby,
    window_opens_s,
)
from scp_recon.errors import InputError, option
from scp_recon.mission.scene import Scene
from scp_recon.mission.schedule import legal_burns, survey
from scp_recon.mission.windows import Window, each_window, scan_step_s, whole_windows
from scp_recon.physics.two_body import two_body
from scp_recon.scenario.fields import ScenarioWarning
from scp_recon.scenario.load import validate_scenario
from scp_recon.scenario.schema import Scenario

INCIDENCE_MAX_DEG, ROOM_DEG = 60.0, 10.0
"""Default limit, and the least room above a site's least incidence: the limit is raised to have it."""


@dataclass(frozen=True)
class GivenBody:
    """A spherical body that is not packaged, by its numbers at the file's epoch.

    The pole is right ascension and declination, J2000; the state is heliocentric, J2000; the period
    sidereal; the meridian is the angle W.

    Attributes:
        gm_m3_s2: gravitational parameter.
        radius_m: of the sphere.
        period_h: sidereal spin period.
        pole_deg: right ascension and declination.
        position_km: from the Sun.
        velocity_km_s: about the Sun.
        meridian_deg: angle W of the prime meridian.
    """

    gm_m3_s2: float
    radius_m: float
    period_h: float
    pole_deg: tuple[float, float]
    position_km: tuple[float, float, float]
    velocity_km_s: tuple[float, float, float]
    meridian_deg: float


Entry = tuple[str, object, str]
"""Key, value, comment: a line of a scenario file."""
Tables = Mapping[str, Sequence[Entry]]


@dataclass(frozen=True)
class Draft:
    """The data of a drafted scenario file.

    Attributes:
        name: of the scenario.
        body: its name.
        incidence_max_deg: limit of the observation.
        design: design of the flyby; None before it is made.
    """

    name: str
    body: str
    given: GivenBody | None
    """None for a packaged body."""
    site_deg: tuple[float, float]
    """Planetocentric latitude and east longitude."""
    epoch: datetime
    """TDB of the first burn."""
    radius_m: float
    """Reference radius of the body."""
    incidence_max_deg: float = INCIDENCE_MAX_DEG
    hours: tuple[float, float] = (8.0, 16.0)
    """Local solar times between which to observe."""
    window_s: Window | None = None
    """Window to be written in the file, because the flight contains an earlier one."""
    design: Design | None = None
    outcome: Sequence[str] = ()
    """Outcome of planning it, in lines."""
    instead: Tables = field(default_factory=dict)
    """Tables by name that come from elsewhere, in place of the template's."""


TEMPLATES = files("scp_recon") / "data" / "drafts"
SIGMA_SHARE = 0.01
"""Assumed 1 sigma of the initial state, all three axes together, over distance and speed."""
DISTANCES, SAFETY = (1.7, 2.6), 1.5
"""Distances in reference radii, to the site and from the centre; Reconnaissance B keeps about these."""


def draft_text(draft: Draft) -> str:
    """Write the scenario file: every entry with unit, frame and source of its value."""
    tables = _tables("scenario", _written(_values(draft)) | _words(draft))
    if (body := draft.given) is not None:
        ra, dec = body.pole_deg
        values = asdict(body) | {"body": draft.body, "epoch": draft.epoch.isoformat()}
        values |= {"radii_m": 3 * [body.radius_m], "pole_ra_deg": ra, "pole_dec_deg": dec}
        tables |= _tables("given_body", _written(values))
    for title, entries in draft.instead.items():
        lines = (f"{key} = {json.dumps(value)}  # {comment}" for key, value, comment in entries)
        tables[title] = "\n".join(lines)
    head = [f"# A flyby of {draft.body}, drafted by scp-recon new."]
    head += [f"# {line}" for line in draft.outcome]
    top, *others = tables.items()
    return "\n".join([*head, top[1], *(f"\n[{title}]\n{lines}" for title, lines in others)]) + "\n"


def _written(values: Mapping[str, object]) -> dict[str, str]:
    """Values as JSON, which is valid TOML; a date is a string in the file, too."""
    return {key: json.dumps(value) for key, value in values.items()}


def _tables(name: str, written: Mapping[str, str]) -> dict[str, str]:
    """Lines of a template's tables by title; lines above the first have none."""
    template = Template((TEMPLATES / f"{name}.template").read_text(encoding="utf-8"))
    parts = re.split(r"^\[(\w+)\]\n", template.substitute(written), flags=re.M)
    tables = zip(["", *parts[1::2]], parts[::2], strict=True)
    return {title: lines.strip() for title, lines in tables if lines.strip()}


def _values(draft: Draft) -> dict[str, object]:
    """Values for the scenario's template."""
    design, radius = draft.design, draft.radius_m
    home = np.array([HOME_RADII * radius, 0.0, 0.0, 0.0, 0.0, 0.0])
    first, last = (home, home) if design is None else (design.initial_state, design.final_state)
    begin = first
    if "boundary" in draft.instead:  # by a trajectory
        given = {key: value for key, value, _ in draft.instead["boundary"]}
        begin = np.concatenate([given["initial_position_m"], given["initial_velocity_m_s"]])
    assumed = SIGMA_SHARE / np.sqrt(3.0) * np.linalg.norm(begin.reshape(2, 3), axis=1)
    return {
        "sigma_position": 3 * [float(f"{assumed[0]:.1g}")],
        "sigma_velocity": 3 * [float(f"{assumed[1]:.1g}")],
        "initial_position": _rounded(first[:3], 3),
        "initial_velocity": _rounded(first[3:], 7),
        "final_position": _rounded(last[:3], 3),
        "final_velocity": _rounded(last[3:], 7),
        "name": draft.name,
        "epoch": draft.epoch.isoformat(),
        "body": draft.body,
        "site": f"{draft.site_deg[0]:g}, {draft.site_deg[1]:g}",
        "latitude": draft.site_deg[0],
        "longitude": draft.site_deg[1],
        "times": (0.0, 1e5) if design is None else design.times_s,
        "largest_burn": 1.0 if design is None else _three(2.0 * float(design.burns_m_s.max())),
        "least_distance": _three(DISTANCES[0] * radius),
        "greatest_distance": _three(DISTANCES[1] * radius),
        "incidence": draft.incidence_max_deg,
        "first_hour": draft.hours[0],
        "last_hour": draft.hours[1],
        "safety": _three(SAFETY * radius),
    }


def _words(draft: Draft) -> dict[str, str]:
    """Words for the template's comments, and the line of a window that must be written."""
    why, window = "recon_b's", ""
    if draft.incidence_max_deg != INCIDENCE_MAX_DEG:  # the site is never so well lit
        least = f"{draft.incidence_max_deg - ROOM_DEG:.0f}"
        why = f"more than recon_b's {INCIDENCE_MAX_DEG:g}, because the least here is about {least}"
    if draft.window_s is not None:
        edges = [round(draft.window_s[0] + 0.5, 1), round(draft.window_s[1] - 0.5, 1)]
        because = "from the lighting, because one comes before it"
        window = f"window_s = {edges}  # s past epoch.tdb; {because}\n"
    names = "home_radii", "slack", "least_radii", "greatest_radii", "safety_radii"
    numbers = zip(names, (HOME_RADII, SLACK_S, *DISTANCES, SAFETY), strict=True)
    return {name: f"{x:g}" for name, x in numbers} | {"why_incidence": why, "window": window}


def _three(value: float) -> float:
    """A number to three digits."""
    return float(f"{value:.3g}")


HALF_WIDTHS_H = (4.0, 1.0, 0.5, 0.25)
"""Half-widths of local solar time about the site's best hour, tried in turn; the first: 8 to 16 h."""
DARK_DEG = 80.0
"""Least incidence of a site that is not worth a visit."""
WINDOW_MIN_S, WINDOW_MAX_S = 120.0, 7200.0
"""Shorter ones show little; a pass leaves the limits of longer ones."""


def scenario_of(draft: Draft) -> Scenario:
    """The scenario that a draft's file holds."""
    return validate_scenario(tomllib.loads(draft_text(draft)))


def drafts(first: Draft) -> Iterator[Draft]:
    """Yield designed flybys of a site: the whole window first, then shorter ones about its best hour.

    The first burn is at the epoch of `first`, which has no design, or later.

    Raises:
        InputError: if the site has no window even with the limit raised to what the site allows.
    """
    scenario = scenario_of(first)
    period = abs(2.0 * np.pi / max(abs(Scene.of(scenario).rotation.rate), 1e-12))
    opens, known = window_opens_s(scenario.schedule), set[Window]()
    for limited, windows in under_limits(first, (0.0, 2.2 * period + opens)):
        window = next((w for w in windows if w[0] >= opens and _is_of_use(w)), None)
        if window is not None and window not in known:
            known.add(window)
            yield _designed(_moved(limited, float(round(window[0] - opens))), opens)
    if not known:
        raise InputError(
            option("site"),
            f"latitude {first.site_deg[0]:g} deg, longitude {first.site_deg[1]:g} deg",
            f"must have a lighting window of {WINDOW_MIN_S:g} to {WINDOW_MAX_S:g} s about the epoch",
        )


def _is_of_use(window: Window) -> bool:
    return WINDOW_MIN_S <= window[1] - window[0] <= WINDOW_MAX_S


def under_limits(draft: Draft, span: Window) -> Iterator[tuple[Draft, list[Window]]]:
    """The draft with limits on the local solar time, widest first, and the site's windows for each.

    The limit on the incidence is raised if the site hardly ever keeps it. The widest limits are
    centred on noon, the others on the site's best hour.

    Raises:
        InputError: if the site is dark.
    """
    scenario = scenario_of(draft)
    lighting, samples_s = Scene.of(scenario).lighting, np.linspace(*span, 4000)
    incidence = np.rad2deg(lighting.incidence(samples_s))
    least, limit = float(incidence.min()), scenario.observation.incidence_max_deg
    if least > DARK_DEG:
        needs = f"must be lit at the epoch, at {DARK_DEG:g} deg or less: take another site or date"
        raise InputError(option("site"), f"a least incidence of {least:.1f} deg", needs)
    limit = max(limit, float(np.ceil(least + ROOM_DEG)))
    best_hour = lighting.local_solar_time(samples_s[np.array([int(np.argmin(incidence))])]).item()
    for half in HALF_WIDTHS_H:
        middle = 12.0 if half == HALF_WIDTHS_H[0] else best_hour
        hours = max(0.0, round(middle - half, 2)), min(24.0, round(middle + half, 2))
        limited = replace(draft, hours=hours, incidence_max_deg=limit)
        yield limited, [w.edges_s for w in survey(scenario_of(limited), span).windows]


def _moved(draft: Draft, shift_s: float) -> Draft:
    """The draft at a later epoch, with a given body's state and angles of that time."""
    epoch = draft.epoch + timedelta(seconds=shift_s)
    if (body := draft.given) is None:
        return replace(draft, epoch=epoch)
    motion = two_body(body.position_km, body.velocity_km_s, (0.0, shift_s))
    turned = body.meridian_deg + 360.0 * shift_s / (3600.0 * body.period_h)
    given = replace(
        body,
        position_km=_rounded(motion(shift_s), 2),
        velocity_km_s=_rounded(motion(shift_s, 1), 8),
        meridian_deg=round(turned % 360.0, 6),
    )
    return replace(draft, epoch=epoch, given=given)


def _rounded(vector: np.ndarray, digits: int) -> tuple[float, float, float]:
    x, y, z = (round(float(value), digits) + 0.0 for value in vector)  # no -0.0
    return x, y, z


def _designed(draft: Draft, opens: float) -> Draft:
    """The draft with its flyby through the window that opens about a time."""
    scene = Scene.of(scenario_of(draft))
    scenario, search = scene.scenario, (0.0, opens + WINDOW_MAX_S + DAY_S)
    slack = scene.lighting.slack(scenario.observation)
    found = list(each_window(slack, search, scan_step_s(scene.rotation.rate, search)))
    window = min(whole_windows(found, search), key=lambda w: abs(w[0] - opens))
    flight = 0.0, burn_times(window, scenario.schedule)[-1]
    alone = next(whole_windows(found, flight)) == window
    return replace(draft, design=design_flyby(scene, window), window_s=None if alone else window)


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
            if times is not None and _is_of_use(window):
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
