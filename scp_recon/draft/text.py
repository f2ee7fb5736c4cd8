"""The scenario file of a draft: every entry with its unit, its frame and where its value came from."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence

from scp_recon.draft.draft import INCIDENCE_MAX_DEG, ROOM_DEG, Draft
from scp_recon.draft.flyby import HOME_RADII

Entry = tuple[str, object, str]
"""Key, value, comment."""

DISTANCES, SAFETY = (1.7, 2.6), 1.5
"""In reference radii, about what Reconnaissance B keeps: to the site, and from the centre."""


def draft_text(draft: Draft, instead: Mapping[str, Sequence[Entry]] | None = None) -> str:
    """The file.

    Args:
        draft: what it is written from.
        instead: tables by name that come from elsewhere, in place of the draft's own.
    """
    lines = [
        f"# A flyby of {draft.body}, drafted by python -m scp_recon.new.",
        *(f"# {line}" for line in draft.outcome),
        *_lines([("name", draft.name, "of the scenario, for tables and figures")]),
    ]
    for title, entries in _tables(draft):
        lines += ["", f"[{title}]", *_lines((instead or {}).get(title, entries))]
    return "\n".join(lines) + "\n"


def _lines(entries: Sequence[Entry]) -> list[str]:
    """Entries with their comments behind them; dates are no strings in TOML, and these are strings."""
    return [f"{key} = {json.dumps(value)}  # {comment}" for key, value, comment in entries]


def _three(value: float) -> float:
    """To three digits."""
    return float(f"{value:.3g}")


def _tables(draft: Draft) -> list[tuple[str, list[Entry]]]:
    return [
        (
            "epoch",
            [
                (
                    "tdb",
                    draft.epoch.isoformat(),
                    "TDB of the first burn: as given, and on until the window comes at a good time",
                )
            ],
        ),
        ("body", _body(draft)),
        ("sun", _sun(draft)),
        ("site", _site(draft)),
        (
            "spacecraft",
            [
                ("mass_kg", 178.0, "kg; NASA MuSCAT's DARE SmallSat, as recon_b"),
                ("srp_area_m2", 0.85, "m^2 lit by the Sun; the same"),
                ("reflectivity_coefficient", 1.127, "C_R, 1 absorbs and 2 reflects; the same"),
            ],
        ),
        ("boundary", _boundary(draft)),
        ("burns", _burns(draft)),
        ("observation", _observation(draft)),
        (
            "safety",
            [
                (
                    "radius_min_m",
                    _three(SAFETY * draft.radius_m),
                    f"m from the centre, at all times; {SAFETY:g} reference radii",
                )
            ],
        ),
        (
            "battery",
            [
                (
                    "delta_v_cone_deg",
                    23.3,
                    "deg, half-angle about the Sun line, both ways, that burns keep out of; recon_b's",
                ),
                (
                    "observation_cone_deg",
                    18.2,
                    "deg, half-angle at the site about the Sun line to keep out of; recon_b's",
                ),
            ],
        ),
        (
            "schedule",
            [
                ("attitude_s", 1800.0, "s, slew until steady; recon_b's"),
                ("heating_s", 1800.0, "s, heating of the thrusters before a burn; recon_b's"),
                ("recharge_s", 1200.0, "s, recharge of the battery from empty; recon_b's"),
            ],
        ),
        (
            "uncertainty",
            [
                (
                    "initial_sigma_fraction",
                    0.01,
                    "1 sigma of each J2000 component of the initial state; recon_b's",
                ),
                (
                    "execution_error",
                    0.02,
                    "1 sigma of each component of a burn, as a share of it; an assumption",
                ),
            ],
        ),
        (
            "risk",
            [("p_chance", 0.7, "least probability of each constraint at each node; recon_b's")],
        ),
        (
            "polytopes",
            [
                ("ball", "paper", "24 facets for distances; recon_b's"),
                ("cone", 12, "facets for angles; finer than recon_b's four"),
            ],
        ),
        ("grid", [("step_max_s", 232.0, "s between nodes at most; recon_b's")]),
    ]


def _body(draft: Draft) -> list[Entry]:
    body = draft.given
    if body is None:
        return [
            (
                "name",
                draft.body,
                "a packaged body: gravity, rotation, radii and the Sun follow, with their sources",
            )
        ]
    ra, dec = body.pole_deg
    return [
        ("name", draft.body, "as given"),
        ("gm_m3_s2", body.gm_m3_s2, "m^3/s^2; as given"),
        ("j2", 0.0, "unnormalised, at reference_radius_m; unknown here"),
        ("reference_radius_m", body.radius_m, "m; as given: the flight stays outside it"),
        ("radii_m", [body.radius_m] * 3, "m, semi-axes body-fixed; a sphere of that radius"),
        ("pole_ra_deg", ra, "deg, right ascension of the spin pole, J2000; as given"),
        ("pole_dec_deg", dec, "deg, declination of the spin pole, J2000; as given"),
        ("rotation_period_h", body.period_h, "h, sidereal, right-handed about the pole; as given"),
        (
            "prime_meridian_at_epoch_deg",
            body.meridian_deg,
            "deg, W at epoch.tdb; 0 at the epoch that was given, so that longitudes count from there",
        ),
    ]


def _sun(draft: Draft) -> list[Entry]:
    constant: Entry = ("solar_constant_w_m2", 1361.0, "W/m^2 at 1 au")
    if draft.given is None:
        return [constant]
    how = "J2000, body from the Sun at epoch.tdb; as given, by two-body motion to there"
    return [
        ("body_position_km", list(draft.given.position_km), f"km, {how}"),
        ("body_velocity_km_s", list(draft.given.velocity_km_s), f"km/s, {how}"),
        constant,
    ]


def _site(draft: Draft) -> list[Entry]:
    latitude, longitude = draft.site_deg
    return [
        ("name", f"{latitude:g}, {longitude:g}", "for tables and figures"),
        ("latitude_deg", latitude, "deg, planetocentric, body-fixed; as given"),
        (
            "longitude_deg",
            longitude,
            "deg east, body-fixed; as given: position and normal follow on the ellipsoid",
        ),
    ]


def _boundary(draft: Draft) -> list[Entry]:
    radius = HOME_RADII * draft.radius_m
    design = draft.design
    states = (
        ([radius, 0.0, 0.0, 0.0, 0.0, 0.0],) * 2
        if design is None
        else (design.initial_state.tolist(), design.final_state.tolist())
    )
    where = f"on a circle of {HOME_RADII:g} reference radii in the terminator plane"
    found: list[Entry] = [("frame", "sun_north", "X to the Sun, Z towards the pole, at epoch.tdb")]
    for which, state in zip(("initial", "final"), states, strict=True):
        position = [round(x, 3) for x in state[:3]]
        velocity = [round(x, 7) for x in state[3:]]
        found += [
            (f"{which}_position_m", position, f"m, body-centred, in boundary.frame; {where}"),
            (f"{which}_velocity_m_s", velocity, "m/s, in boundary.frame; two-body speed there"),
        ]
    return found


def _burns(draft: Draft) -> list[Entry]:
    design = draft.design
    times = (0.0, 1e5) if design is None else design.times_s
    largest = 1.0 if design is None else 2.0 * float(design.burns_m_s.max())
    return [
        (
            "times_s",
            list(times),
            "s past epoch.tdb; about the window by the schedule's rules, with 500 s of room",
        ),
        ("dv_max_m_s", _three(largest), "m/s, largest burn; twice that of two-body motion"),
    ]


def _why_incidence(limit: float) -> str:
    """Recon_b's, unless the site is never so well lit."""
    if limit == INCIDENCE_MAX_DEG:
        return "recon_b's"
    least = f"{limit - ROOM_DEG:.0f}"
    return f"more than recon_b's {INCIDENCE_MAX_DEG:g}, because the least here is about {least}"


def _observation(draft: Draft) -> list[Entry]:
    low, high = DISTANCES
    window: list[Entry] = []
    if draft.window_s is not None:
        edges = [round(draft.window_s[0] + 0.5, 1), round(draft.window_s[1] - 0.5, 1)]
        window = [
            ("window_s", edges, "s past epoch.tdb; from the lighting, because one comes before it")
        ]
    return [
        ("site_distance_min_m", _three(low * draft.radius_m), f"m; {low:g} reference radii"),
        ("site_distance_max_m", _three(high * draft.radius_m), f"m; {high:g} reference radii"),
        ("emission_min_deg", 20.0, "deg between the site's normal and the spacecraft; recon_b's"),
        ("emission_max_deg", 45.0, "deg; recon_b's"),
        ("phase_min_deg", 10.0, "deg at the site between Sun and spacecraft; recon_b's"),
        (
            "incidence_max_deg",
            draft.incidence_max_deg,
            f"deg between the site's normal and the Sun; {_why_incidence(draft.incidence_max_deg)}",
        ),
        (
            "local_solar_time_min_h",
            draft.hours[0],
            "h at the site; 8 to 16, or as much as can be flown",
        ),
        ("local_solar_time_max_h", draft.hours[1], "h; the same"),
        *window,
    ]
