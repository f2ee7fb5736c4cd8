"""Check quantities against intervals: each is one row of data.

A row refuses a value outside its wider interval, such as kilometres in place of metres. It warns of
a value outside its narrower interval. A new limit on an entry's value is a new row here.
docs/reference/warnings.md shows the rows.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from scipy.constants import G

from formulations.rows.flight_probability import PROBABILITY_MAX
from scp_recon.bodies.catalogue import AU_KM, ECLIPTIC_NORTH, GM_SUN_KM3_S2, packaged_body
from scp_recon.bodies.surface import angle_deg
from scp_recon.display import digits, exact
from scp_recon.errors import InputError
from scp_recon.mission.scene import NODES_MAX, RK4_STEP_MAX_S, Scene, orbit_of_body
from scp_recon.scenario.fields import ScenarioWarning, Section, unit_hint
from scp_recon.scenario.given import shown
from scp_recon.scenario.schema import Battery, Observation, ScheduleRules

Ends = tuple[float, float]
"""Ends of an interval; an infinite one bounds nothing."""
INF = math.inf


@dataclass(frozen=True)
class Interval:
    """A quantity of a scenario, and the intervals that refuse it or warn of it."""

    entries: str
    """Dotted paths, separated by spaces; each has the quantity."""
    quantity: str = ""
    """Bounded quantity in words; the entry itself, or its length, if empty."""
    value: Callable[[Scene, str], float | None] = lambda scene, entry: size(value_at(scene, entry))
    """The quantity of an entry; None where the row does not apply."""
    unit: str = ""
    refuse: Ends | None = None
    warn: Ends | None = None
    hint: str = ""
    """The likely slip, or the reason."""
    or_zero: bool = False
    """Whether zero is meant, and never in question."""
    scale: tuple[Callable[[Scene, str], float | None], str] | None = None
    """Unit of the ends, as a function, and its name; None where the row does not apply."""

    def check(self, scene: Scene) -> Iterator[ScenarioWarning]:
        """Check a scene against the row; yield its warnings.

        Raises:
            InputError: naming the entry, what was given and what is allowed.
        """
        for entry in self.entries.split():
            value = self.value(scene, entry)
            if value is None or (self.or_zero and value == 0.0):
                continue
            scale = self.scale[0](scene, entry) if self.scale else 1.0
            if scale is None:
                continue
            if self.refuse and not self.refuse[0] <= value / scale <= self.refuse[1]:
                allowed = f"must be {self._expected(self.refuse, scale, value)}"
                raise InputError(entry, self._shown(value_at(scene, entry), value), allowed)
            if self.warn and not self.warn[0] <= value / scale <= self.warn[1]:
                expected = f"expected {self._expected(self.warn, scale, value)}"
                given = self._shown(value_at(scene, entry), value)
                yield ScenarioWarning.of(entry, given, expected)

    def _shown(self, given: Any, value: float) -> str:
        """The quantity beside the number or vector it is computed from."""
        if not self.quantity:
            text = exact(value) if isinstance(given, float) else _number(value)
            return f"{text} {self.unit}".rstrip()
        number = f"{self.quantity}: {_number(value, 3)} {self.unit}".rstrip()
        if isinstance(given, tuple) and (len(given) > 3 or isinstance(given[0], tuple)):
            return number
        return f"{shown(given)} ({number})"

    def _expected(self, ends: Ends, scale: float, value: float) -> str:
        hint = self.hint
        if "?" not in hint and self.unit:
            hint += unit_hint(self.unit, value, ends[0] * scale, ends[1] * scale)
        if self.scale is None:
            return f"{self.within(ends)}{hint}"
        absolute = _within((ends[0] * scale, ends[1] * scale), self.unit)
        relative = _within(ends, self.scale[1]).removeprefix("at least ").removeprefix("at most ")
        return f"{self._zero(ends)}{absolute} ({relative}){hint}"

    def within(self, ends: Ends) -> str:
        """An interval in words: "300 to 8000 kg/m^3", "0, or at least 60 s", "at most 2 radii"."""
        return self._zero(ends) + _within(ends, self.scale[1] if self.scale else self.unit)

    def _zero(self, ends: Ends) -> str:
        return "0, or " if self.or_zero and ends[0] > 0.0 else ""


VAST = 1e7
"""Numbers from here on have an exponent."""


def _number(value: float, figures: int = 4) -> str:
    return digits(value, figures) if abs(value) < VAST else f"{value:.{figures}g}"


def _within(ends: Ends, unit: str) -> str:
    low, high = ends
    words = f"{_number(low)} to {_number(high)}"
    if high == INF:
        words = f"at least {_number(low)}"
    elif low == -INF:
        words = f"at most {_number(high)}"
    words = f"{words} {unit}".rstrip()
    return words.replace(" 1 times ", " ") if words.startswith("at ") else words


def value_at(scene: Scene, entry: str) -> Any:
    """Value of a scenario at a dotted path; None below a table that it lacks."""
    found: Any = scene.scenario
    for key in entry.split("."):
        found = getattr(found, key, None)
    return found


def size(given: Any) -> float | None:
    """A number, or the length of a vector."""
    if given is None:
        return None
    return math.hypot(*given) if isinstance(given, tuple) else float(given)


# --- quantities -------------------------------------------------------------------------------------

J2_ENDS = 0.0, 0.5
"""Ends of J2 at the reference radius; Itokawa, twice as long as thick, has half of the larger."""


J2_SLACK = 0.01
"""How far J2 may be off that of an ellipsoid in any case."""


def density(gm: float, radius: float) -> float:
    """Density in kg/m^3 of a ball by its GM in m^3/s^2 and its radius in m."""
    return float(gm / (G * 4.0 / 3.0 * np.pi * radius**3))


def _density(scene: Scene, _: str) -> float:
    body = scene.scenario.body
    known, radius = packaged_body(body.name), body.reference_radius_m
    if known is not None:  # whose sphere may be far larger than the body
        radius = min(radius, _mean_m(known.entries["radii_m"]))
    return density(body.gm_m3_s2, radius)


def _mean_m(radii_m: Sequence[float]) -> float:
    """Radius of a ball as large as an ellipsoid."""
    return math.prod(radii_m) ** (1.0 / 3.0)


def _mean_radius_m(scene: Scene, _: str = "") -> float | None:
    """Mean radius of the ellipsoid of a body that is not packaged, m."""
    body = scene.scenario.body
    if body.radii_m is None or packaged_body(body.name) is not None:
        return None
    return _mean_m(body.radii_m)


def _ellipsoid_j2(scene: Scene, _: str) -> float | None:
    """J2 = (a^2 + b^2 - 2 c^2) / (10 R^2) of a homogeneous ellipsoid that is not packaged."""
    body = scene.scenario.body
    if body.radii_m is None or packaged_body(body.name) is not None:
        return None
    a, b, c = body.radii_m
    even = (a * a + b * b - 2.0 * c * c) / (10.0 * body.reference_radius_m**2)
    return even if abs(body.j2 - even) > J2_SLACK and even > 0.0 else None


def _slope_deg(scene: Scene, _: str) -> float:
    return angle_deg(scene.site.position_body, scene.site.normal_body)


def _off_the_equator(scene: Scene, _: str) -> float:
    """Angle of the orbit's plane off Earth's equator over its angle off the ecliptic.

    Components along the axes of the ecliptic, which many tables have, make the inclination the angle
    off the equator. Below 0.4 they explain the numbers clearly better: that is so of any inclination up
    to 6.7 deg with wrong axes, and of none below 16.7 deg with the right ones.
    """
    normal = orbit_of_body(scene).normal
    return angle_deg(normal, [0.0, 0.0, 1.0]) / max(angle_deg(normal, ECLIPTIC_NORTH), 1e-9)


def _off_shadow_m(scene: Scene, entry: str) -> float | None:
    """Distance from the shadow's axis behind the body: the planner's forces leave the shadow out."""
    which = "initial" if "initial" in entry else "final"
    position = scene.boundary_state(which)[:3]
    light = scene.sun_direction(0.0 if which == "initial" else scene.scenario.duration_s)
    behind = float(position @ light) < 0.0
    return float(np.linalg.norm(np.cross(position, light))) if behind else None


def _nearest_to_site_m(scene: Scene, _: str) -> float | None:
    """The least distance from the site outside the safety radius."""
    clear = scene.scenario.safety.radius_min_m - float(np.linalg.norm(scene.site.position_body))
    return clear if clear > 0.0 else None


def _escape_m_s(scene: Scene, entry: str) -> float:
    """Escape speed at the position that belongs to a velocity entry."""
    distance = math.hypot(*value_at(scene, entry.replace("velocity_m_s", "position_m")))
    return math.sqrt(2.0 * scene.scenario.body.gm_m3_s2 / distance)


def _largest_speed_m_s(scene: Scene, _: str) -> float:
    body, boundary = scene.scenario.body, scene.scenario.boundary
    escape = math.sqrt(2.0 * body.gm_m3_s2 / body.reference_radius_m)
    ends = boundary.initial_velocity_m_s, boundary.final_velocity_m_s
    return max(escape, *(math.hypot(*end) for end in ends))


def _outside_m(scene: Scene, entry: str) -> float | None:
    """Boundary states that follow from a home orbit have its radius."""
    of_home = entry.startswith("boundary.") and scene.scenario.boundary.home is not None
    return None if of_home and entry != HOME else size(value_at(scene, entry))


def _nearer_end_m(scene: Scene, _: str) -> float:
    """Distance of the nearer end of the flight from the centre."""
    boundary = scene.scenario.boundary
    return min(math.hypot(*boundary.initial_position_m), math.hypot(*boundary.final_position_m))


def _sigma(scene: Scene, entry: str, part: int) -> float | None:
    """The largest 1-sigma error that an entry gives, of the initial or the measured state, m or m/s."""
    if entry.startswith("navigation."):
        measured = value_at(scene, entry)
        matrix = np.ndim(measured) == 2
        return float(np.sqrt(np.diag(measured))[3 * part :][:3].max()) if matrix else measured
    given, flight = scene.scenario.uncertainty, scene.scenario.in_flight
    said = f"uncertainty.initial_sigma_{('position_m', 'velocity_m_s')[part]}"
    if flight is not None and flight.covariance is not None:
        said = "in_flight.covariance"
    elif given.initial_sigma_fraction is not None:
        said = "uncertainty.initial_sigma_fraction"
    elif given.initial_covariance is not None:
        said = "uncertainty.initial_covariance"
    if entry != said:
        return None
    sigma = np.linalg.norm(scene.initial_factor(scene.initial_state), axis=1)
    return float(sigma.reshape(2, 3)[part].max())


def _distance_m(scene: Scene, _: str) -> float:
    return float(np.linalg.norm(scene.initial_state[:3]))


def _speed_m_s(scene: Scene, entry: str) -> float:
    """Speed where planning begins, or that of a circular orbit there, whichever is larger."""
    circular = math.sqrt(scene.scenario.body.gm_m3_s2 / _distance_m(scene, entry))
    return max(float(np.linalg.norm(scene.initial_state[3:])), circular)


def _entries(table: str, model: type[Section], ending: str) -> str:
    return " ".join(f"{table}.{key}" for key in model.model_fields if key.endswith(ending))


RADIAN_DEG = 0.5 * math.pi
"""Bound on every angle of a cone in radians; below it degrees were hardly meant."""
SPREADS = "in_flight.covariance uncertainty.initial_sigma_fraction uncertainty.initial_covariance"
SPREAD = (1e-4, 0.0999)
"""1 sigma over distance or speed: 0.1 m at 1 km is the best that is flown. The ends are less than a
factor of 1000 apart, so that nothing between them is there in kilometres, or millimetres, too."""
BELOW = (-INF, math.nextafter(1.0, 0.0))
"""Refuses what is as large as the scale, or larger."""
DENSITIES = (3.0, 1e6)
"""Density of any body by a radius within a factor of five of its own, kg/m^3."""
SPIN, SUN_SPEED = "body.prime_meridian_rate_deg_day", "sun.body_velocity_km_s"
HOME, FLIGHT = "boundary.home.radius_m", "in_flight.position_m"
ENDS = "boundary.initial_position_m boundary.final_position_m"
STEPS = f": the planner's steps are {RK4_STEP_MAX_S:g} s"
RADII = (lambda scene, _: scene.scenario.body.reference_radius_m), "reference radii"
ESCAPE = _escape_m_s, "times the speed of escape there"
SPEED = Interval(
    "boundary.initial_velocity_m_s boundary.final_velocity_m_s", unit="m/s", refuse=(-INF, 10.0),
    warn=(0.01, 5.0), hint=", in metres per second", or_zero=True, scale=ESCAPE)  # fmt: skip
TOO_FAR = Interval(ENDS, "from the centre", unit="m", refuse=(-INF, 100.0), hint=", in metres",
    scale=(_nearer_end_m, "times the nearer end of the flight"))  # fmt: skip
"""Rows for states in millimetres, which are a thousand times too large."""
SIGMAS = (
    Interval(f"{SPREADS} uncertainty.initial_sigma_position_m", "1 sigma",
        lambda s, entry: _sigma(s, entry, 0), "m", refuse=BELOW, warn=SPREAD,
        hint="; metres and seconds?", or_zero=True,
        scale=(_distance_m, "times the distance from the centre")),
    Interval(f"{SPREADS} uncertainty.initial_sigma_velocity_m_s", "1 sigma",
        lambda s, entry: _sigma(s, entry, 1), "m/s", refuse=BELOW, warn=SPREAD,
        hint="; metres and seconds?", or_zero=True,
        scale=(_speed_m_s, "times the speed, or that of a circular orbit")),
)  # fmt: skip
"""Rows for the state where planning begins; what is measured of it is never without an error."""

PLANNER_INTERVALS = (
    Interval("grid.nodes_s", "the last", lambda s, entry: max(value_at(s, entry), default=0.0), "s",
        refuse=(-INF, 1.0), scale=(lambda s, _: s.scenario.duration_s, "times the flight")),
    Interval("grid.step_max_s", "nodes in the flight",
        lambda s, entry: s.scenario.duration_s / float(value_at(s, entry)), refuse=(-INF, NODES_MAX),
        hint="; a shorter flight, or longer steps"),
    # Beside it site and flight would be called too near the centre.
    Interval("body.reference_radius_m", unit="m", refuse=(-INF, 1.0),
        scale=(
            lambda s, e: max(
                5.0 * float(np.linalg.norm(s.site.position_body)), _nearer_end_m(s, e)
            ),
            "times the nearer end of the flight, or 5 times the site's distance",
        )),
    # The body moves on a straight line, which must not lead to the Sun.
    Interval(SUN_SPEED, unit="km/s", refuse=(-INF, 0.5),
        scale=(
            lambda s, _: math.hypot(*s.scenario.sun.body_position_km) / s.scenario.duration_s,
            "times the way to the Sun in the flight",
        )),
    Interval(f"{ENDS} {HOME} {FLIGHT}",
        "from the centre", _outside_m, "m", refuse=(math.nextafter(1.0, 2.0), INF),
        hint=", outside the body", scale=RADII),
    Interval("safety.radius_min_m", unit="m", refuse=(-INF, 1.0),
        scale=(_nearer_end_m, "times the nearer end of the flight")),
    # Where a flight turns by a radian per step.
    Interval("body.gm_m3_s2", unit="m^3/s^2", refuse=(-INF, 1.0), hint=STEPS,
        scale=(
            lambda s, entry: _nearer_end_m(s, entry) ** 3 / RK4_STEP_MAX_S**2,
            "times what can be planned about from the boundary",
        )),
    Interval(FLIGHT, "from the centre", unit="m", refuse=(1.0, INF), hint=STEPS,
        scale=(
            lambda s, _: (s.scenario.body.gm_m3_s2 * RK4_STEP_MAX_S**2) ** (1.0 / 3.0),
            "times the least distance that can be planned from",
        )),
)  # fmt: skip
"""Beyond which a plan would never end, or end in figures that are not finite."""
INTERVALS = (
    # From the most porous comet to iron; a reference radius may be well above the body's own.
    Interval("body.gm_m3_s2", "density at body.reference_radius_m", _density, "kg/m^3",
        refuse=DENSITIES, warn=(300.0, 8000.0)),
    # A reference radius is one of the body's, which an ellipsoid's diameters are not.
    Interval("body.radii_m", "of a body that is not packaged, the mean", _mean_radius_m, "m",
        warn=(0.55, 1.5), scale=RADII, hint="; radii both, and no diameters?"),
    # From the most porous body that was visited: comet 67P has 530. An eighth is that of diameters.
    Interval("body.radii_m", "density of a body that is not packaged",
        lambda s, _: (mean := _mean_radius_m(s)) and density(s.scenario.body.gm_m3_s2, mean),
        "kg/m^3", warn=(500.0, 8000.0), hint="; radii, and no diameters?"),
    Interval("epoch.tdb", "years after 2000", lambda s, _: s.scenario.epoch.tdb.year - 2000.0,
        warn=(-INF, 100.0), hint="; is it right?"),
    # Below any body that has been flown to: Dimorphos has 75 m. In kilometres throughout, GM included,
    # a body is a smaller one of the same density.
    Interval("body.reference_radius_m", unit="m", warn=(50.0, INF), hint="; all of it in metres?"),
    # Without strength it breaks up: Pravec & Harris 2000.
    Interval(SPIN, "a turn of a body above 150 m",
        lambda s, _: s.rotation.period_h if s.scenario.body.reference_radius_m > 150.0 else None,
        "h", warn=(2.0, INF), hint=": it breaks up"),
    Interval(SPIN, "a turn", lambda s, _: s.rotation.period_h, "h", warn=(-INF, 2000.0),
        hint="; degrees a day?"),
    # What turns freely ends turning about its shortest axis, which is body-fixed z; 2 % are rounding
    # of nearly round bodies.
    Interval("body.radii_m", "the last over the shortest",
        lambda s, _: (radii := s.scenario.body.radii_m) and radii[2] / min(radii[:2]),
        warn=(-INF, 1.02), hint=", as bodies turn about the shortest; are the axes in order?"),
    Interval("body.j2", "of a body that is not packaged",
        lambda s, _: None if packaged_body(s.scenario.body.name) else s.scenario.body.j2,
        warn=J2_ENDS, hint="; unnormalised, which is -sqrt(5) C20?"),
    # Bennu's is 20 % above, and Eros' 13 %; C20 normalised in its place is sqrt(5) times too small.
    Interval("body.j2", warn=(0.6, 1.0 / 0.6), hint="; unnormalised, which is -sqrt(5) C20?",
        scale=(_ellipsoid_j2, "times that of a homogeneous ellipsoid of body.radii_m")),
    # Oblateness shortens the period by a per cent or two; in km/s or days it is far off.
    Interval("body.companion.period_h", "n^2 a^3 over the sum of both GM",
        lambda s, _: None if (other := s.companion) is None else (
            other.rate**2 * other.semi_major_axis**3 / (s.scenario.body.gm_m3_s2 + other.gm)
        ),
        refuse=(0.8, 1.25), warn=(0.95, 1.05), hint=", by Kepler's third law"),
    Interval("body.companion.semi_major_axis_m", "from the surface at the nearest",
        lambda s, _: None if (other := s.companion) is None else (
            other.semi_major_axis * (1.0 - other.eccentricity) - s.scenario.body.reference_radius_m
        ),
        "m", refuse=(1.0, INF), hint=", outside the body",
        scale=(lambda s, _: value_at(s, "body.companion.radius_m"), "of its radii")),
    # Of a surface point: an elongated body reaches beyond its mean radius.
    Interval("site.position_body_m", "from the centre",
        lambda s, _: float(np.linalg.norm(s.site.position_body)), "m",
        refuse=(0.1, 5.0), warn=(0.3, 2.0), scale=RADII),
    Interval("site.normal_body", "off the direction from the centre to the site", _slope_deg, "deg",
        refuse=(-INF, 90.0), hint=": it points out of the body"),
    # An ellipsoid of axes 2 to 1 has up to 37 deg; with a shape its own normal was compared.
    Interval("site.normal_body", "without a shape off the direction from the centre",
        lambda s, entry: None if s.scenario.body.radii_m else _slope_deg(s, entry), "deg",
        warn=(-INF, 30.0)),
    Interval("sun.body_position_km", "from the Sun", unit="km", refuse=(0.1, 50.0),
        scale=(lambda _, __: AU_KM, "au"), hint=", in kilometres"),
    # Its square is 2: beyond it nothing in the Solar System moves.
    Interval(SUN_SPEED, unit="km/s", refuse=(-INF, math.sqrt(2.0)),
        scale=(
            lambda s, _: (2.0 * GM_SUN_KM3_S2 / math.hypot(*s.scenario.sun.body_position_km)) ** 0.5,
            "times the speed of escape from the Sun",
        )),
    # The orbits of what is flown to.
    Interval(
        SUN_SPEED, "semi-major axis of the orbit", lambda s, _: orbit_of_body(s).axis / AU_KM, "au",
        warn=(0.5, 6.0)),
    # Few asteroids are beyond either; a Sun whose axes are swapped often is.
    Interval(SUN_SPEED, "eccentricity of the orbit",
        lambda s, _: float(np.linalg.norm(orbit_of_body(s).eccentricity)),
        warn=(-INF, 0.9), hint="; are the axes in order?"),
    Interval(SUN_SPEED, "the orbit's plane off the ecliptic",
        lambda s, _: angle_deg(orbit_of_body(s).normal, ECLIPTIC_NORTH), "deg",
        warn=(-INF, 50.0), hint="; J2000, axes in order?"),
    Interval(SUN_SPEED, "the orbit's plane off Earth's equator, over its angle off the ecliptic",
        _off_the_equator, warn=(0.4, INF), hint="; components along the ecliptic's axes?"),
    Interval("safety.radius_min_m", unit="m", refuse=(1.0, INF), hint=": below it is the inside",
        scale=RADII),
    Interval("observation.site_distance_max_m", unit="m", refuse=(1.0, INF),
        scale=(_nearest_to_site_m, "times the least distance outside the safety radius")),
    Interval("observation.site_distance_min_m", unit="m", warn=(-INF, 100.0), scale=RADII),
    Interval("observation.site_distance_min_m", "the largest distance over it",
        lambda s, entry: s.scenario.observation.site_distance_max_m / float(value_at(s, entry)),
        warn=(-INF, 10.0), hint="; metres both?"),
    Interval(ENDS, "from the centre", unit="m", warn=(-INF, 100.0), scale=RADII),
    TOO_FAR,
    # Swapped axes may lead there.
    Interval(ENDS, "off the axis of the body's shadow", _off_shadow_m, "m", warn=(1.0, INF),
        hint="; the frame and its axes?", scale=RADII),
    SPEED,
    # A limit on the burns is one only where it can bind: more than that turns any flight here round.
    Interval("burns.dv_max_m_s", unit="m/s", warn=(-INF, 20.0),
        scale=(_largest_speed_m_s, "times the largest speed at the ends, or that of escape")),
    Interval("burns.dv_min_m_s", unit="m/s", warn=(-INF, 0.5), refuse=(-INF, 1.0), or_zero=True,
        scale=(lambda s, _: s.scenario.burns.dv_max_m_s, "times burns.dv_max_m_s")),
    Interval(f"{_entries('observation', Observation, '_deg')} {_entries('battery', Battery, '_deg')}",
        unit="deg", warn=(RADIAN_DEG, INF), hint="; degrees?", or_zero=True),
    # From a solid block to a solar sail.
    Interval("spacecraft.srp_area_m2", "over the mass",
        lambda s, entry: float(value_at(s, entry)) / s.scenario.spacecraft.mass_kg, "m^2/kg",
        warn=(1e-4, 1.0), or_zero=True),
    # Of what is between a mirror that sends the light on and one that sends it back.
    Interval("spacecraft.reflectivity_coefficient", warn=(0.5, 2.0), or_zero=True,
        hint=": 1 absorbs, 2 reflects everything"),
    # 1361 and what was once measured of it.
    Interval("sun.solar_constant_w_m2", unit="W/m^2", warn=(1300.0, 1420.0), hint=" at 1 au"),
    Interval(f"{_entries('schedule', ScheduleRules, '_s')} navigation.lead_s", unit="s",
        warn=(60.0, INF), hint="; seconds?", or_zero=True),
    Interval("uncertainty.gates.magnitude_fixed_m_s uncertainty.gates.pointing_fixed_m_s", unit="m/s",
        refuse=BELOW, scale=(lambda s, _: s.scenario.burns.dv_max_m_s, "times burns.dv_max_m_s")),
    # Beyond it a per cent was meant, or there is nothing to plan with.
    Interval("uncertainty.execution_error "
        "uncertainty.gates.magnitude_proportional uncertainty.gates.magnitude_bias",
        unit="of a burn", warn=(-INF, 0.3), hint=": it is a share, not in per cent"),
    # Pointing included: no thruster is known to a tenth of a degree.
    Interval("uncertainty.execution_error", unit="of a burn", warn=(1e-3, INF), or_zero=True,
        hint="; divided by a hundred once too often?"),
    Interval("risk.p_chance", 'the risk left with risk.scope = "flight"',
        lambda s, _: 1.0 - s.scenario.risk.p_chance if s.scenario.risk.scope == "flight" else None,
        refuse=(1.0 - PROBABILITY_MAX, INF),
        hint=": below it the estimate errs by as much as is left"),
)  # fmt: skip
"""Rows for a scenario before its window is known, in the order of checking."""
STATE_INTERVALS = (
    Interval(FLIGHT, "from the centre", unit="m", warn=(-INF, 100.0), scale=RADII),
    replace(TOO_FAR, entries=FLIGHT),
    replace(SPEED, entries="in_flight.velocity_m_s"),
    *SIGMAS,
    *(
        replace(row, entries=f"navigation.covariance {measured}", refuse=None, or_zero=False)
        for row, measured in zip(
            SIGMAS, ("navigation.sigma_position_m", "navigation.sigma_velocity_m_s"), strict=True
        )
    ),
)  # fmt: skip
"""Rows for the state where planning begins: for a flight under way, the state in flight."""
