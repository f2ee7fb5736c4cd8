"""Define the schema of a scenario: frozen tables with units in the keys, validated together."""

from __future__ import annotations

import itertools
import json
import math
from collections.abc import Mapping
from datetime import datetime
from typing import Annotated, Any, Literal, Self

from pydantic import (
    Field,
    SerializerFunctionWrapHandler,
    ValidationError,
    field_validator,
    model_serializer,
    model_validator,
)

from scp_recon.errors import InputError, shortened
from scp_recon.scenario.body import Body, Boundary, Design, SiteSection, Sun
from scp_recon.scenario.derive import derive
from scp_recon.scenario.fields import (
    ConeAngle,
    FlightTime,
    Name,
    NonNegative,
    Positive,
    Section,
    Tdb,
    unit_hint,
)
from scp_recon.scenario.given import inherit, tables_of
from scp_recon.scenario.knowledge import Knowledge
from scp_recon.scenario.messages import input_error
from scp_recon.scenario.uncertainty import InFlight, Navigation, Policy, Uncertainty


class Epoch(Section):
    """Time zero of the flight."""

    tdb: Tdb
    """TDB at the first burn, such as 2020-01-21T20:33:17.184; no time zone. Follows from utc."""
    utc: datetime | None = None
    """UTC at the first burn, such as 2020-01-21T20:32:08Z, in place of tdb, which alone is kept; beside
    it, it has to agree."""


class Spacecraft(Section):
    """Mass and cannonball model of solar radiation pressure."""

    mass_kg: Positive
    """Mass in kg."""
    srp_area_m2: NonNegative
    """Area that the Sun lights in m^2."""
    reflectivity_coefficient: NonNegative
    """Cannonball coefficient C_R: 1 absorbs, 2 reflects everything."""


class Burns(Section):
    """Firing times, the first at zero and the last at the end of the flight."""

    times_s: Annotated[tuple[FlightTime, ...], Field(min_length=2, max_length=64)]
    """Firing times in s after the epoch, the first at 0."""
    dv_max_m_s: Annotated[float, Field(ge=1e-9, le=1e6)]
    """Largest size of a burn in m/s."""
    dv_min_m_s: Annotated[float, Field(ge=0, le=1e6)] = 1e-4
    """Smallest burn that is executed in m/s; 0 for any. The default is an assumption: a tenth of the
    1 mm/s to which small manoeuvres of OSIRIS-REx were precise (Williams et al., SSR 214:69, 2018)."""

    @field_validator("times_s")
    @classmethod
    def _ascending_from_zero(cls, times: tuple[float, ...]) -> tuple[float, ...]:
        if times[0] != 0.0 or any(b <= a for a, b in itertools.pairwise(times)):
            raise ValueError("must start at 0 and be strictly ascending")
        return times


class Observation(Section):
    """Limits on the observation geometry; those without a bound are left out."""

    site_distance_min_m: Positive
    """Least distance from the site in m."""
    site_distance_max_m: Positive
    """Greatest distance from the site in m."""
    emission_min_deg: ConeAngle
    """Least angle at the site between its normal and the spacecraft in deg."""
    emission_max_deg: ConeAngle
    """Greatest of these angles in deg."""
    phase_min_deg: ConeAngle
    """Least angle at the site between the Sun and the spacecraft in deg."""
    phase_max_deg: ConeAngle | None = None
    """Greatest of these angles in deg; no limit if left out."""
    incidence_max_deg: Annotated[float, Field(gt=0, le=180)]
    """Greatest angle at the site between its normal and the Sun in deg."""
    local_solar_time_min_h: Annotated[float, Field(ge=0, le=24)]
    """Earliest local solar time at the site in h, 12 at the Sun's crossing of its meridian."""
    local_solar_time_max_h: Annotated[float, Field(ge=0, le=24)]
    """Latest local solar time at the site in h."""
    window_s: tuple[float, float] | None = None
    """Start and end of the observation in s after the epoch; computed from the lighting if left out."""
    required: bool | None = None
    """Whether the site has to be observed. If false, as on the way home after a missed burn, limits of
    the observation are not planned; the schedule still leaves its window to it. True if left out."""

    @model_validator(mode="after")
    def _ordered(self) -> Self:
        for name, unit in (
            *(("site_distance", "m"), ("emission", "deg"), ("phase", "deg")),
            ("local_solar_time", "h"),
        ):
            low, high = (getattr(self, f"{name}_{end}_{unit}") for end in ("min", "max"))
            if high is not None and low >= high:
                hint = unit_hint(unit, high, low, math.inf) or unit_hint(unit, low, 0.0, high)
                hint = "; degrees?" if unit == "deg" and high < 0.5 * math.pi else hint
                rule = f"the minimum {low} must be below the maximum {high}{hint}"
                raise ValueError(f"{name}: {rule}")
        return self


DRIFT_S, DRIFT_PROBABILITY = 86400.0, 0.997


class Safety(Section):
    """Distances from the centres of body and companion, in the flight and after a missed burn."""

    radius_min_m: Positive
    """Least distance from the body's centre in m."""
    companion_distance_min_m: Positive | None = None
    """Least distance from the centre of body.companion in m; its radius_m if left out."""
    missed_burns: Literal[1] | None = None
    """Burns that may be missed: 1 for any one of burns 2 to the last, after which no burn follows and
    the free drift stays safe. Not planned if left out."""
    cut_short: bool | None = None
    """Whether any one of these burns may stop at 0.1, 0.3, 0.5, 0.7 or 0.9 of its size."""
    drift_s: Annotated[float, Field(gt=0, le=1e7)] | None = None
    """Time in s for which a drift stays outside drift_radius_m; a day if left out."""
    drift_probability: Annotated[float, Field(gt=0.5, le=1 - 1e-5)] | None = None
    """Least probability that a whole drift is safe, of each miss by itself; 0.997 if left out."""
    drift_radius_m: Positive | None = None
    """Least distance of a drift from the body's centre in m; radius_min_m if left out."""


class Battery(Section):
    """Half-angles about the Sun line: of burns (both ways) and, from the site, while observing."""

    delta_v_cone_deg: ConeAngle
    """Half-angle in deg of the cones about the Sun line, both ways, that burns keep out of."""
    observation_cone_deg: ConeAngle
    """Half-angle in deg of the cone at the site about the Sun line that the flight keeps out of."""


class ScheduleRules(Section):
    """Worst-case durations of slew, heating and recharge."""

    attitude_s: FlightTime
    """Slew until steady in s."""
    heating_s: FlightTime
    """Heating of the thruster before a burn in s."""
    recharge_s: FlightTime
    """Recharge of the battery from empty in s."""

    @property
    def sun_leg_s(self) -> float:
        """Least time in sun-pointing mode: one slew and one recharge."""
        return self.attitude_s + self.recharge_s

    @property
    def before_burn_s(self) -> float:
        """Time in delta-V mode that ends with a burn: one slew and one heating."""
        return self.attitude_s + self.heating_s

    @property
    def cycle_s(self) -> float:
        """Least time from a burn, or the end of the window, to the next burn."""
        return self.sun_leg_s + self.before_burn_s

    @property
    def before_window_s(self) -> float:
        """Least time from a burn to the window: a sun-pointing leg and a slew."""
        return self.sun_leg_s + self.attitude_s


class Risk(Section):
    """Required probability, its scope, and how the risk is spent.

    With the scope `node` every joint constraint at every node has to hold with `p_chance`; with
    `flight` all of them together, at all nodes of a flight. `uniform` splits a risk evenly over
    polytopes' facets by Boole's inequality; `exact` spends the probability of the sets themselves.
    """

    p_chance: Annotated[float, Field(gt=0.5, le=1 - 1e-9)]
    """Least probability of what `scope` names; of whole flights at most 1 - 1e-5."""
    allocation: Literal["uniform", "exact"] = "uniform"
    """How risk is spent: evenly over facets (Boole), or as the probabilities of the sets themselves."""
    scope: Literal["node", "flight"] = "node"
    """Event that has to hold: each joint constraint at each node, or all at all nodes of a flight."""
    sampling: Literal["strata", "plain"] = "strata"
    """Draws that are flown to certify: few, mostly near a limit by the law, or all."""

    @model_validator(mode="after")
    def _flights_are_exact(self) -> Self:
        if self.scope == "flight" and self.allocation != "exact":
            raise ValueError('scope = "flight" must have allocation = "exact"')
        return self


class PolytopeSection(Section):
    """Polytopes that approximate balls and cones in P2."""

    ball: Literal["paper", "tangent"] | Annotated[int, Field(ge=4, le=512)]
    """For distances: "paper" (24 facets), "tangent" (at the line of sight), or a number of facets."""
    cone: Literal["paper"] | Annotated[int, Field(ge=3, le=512)]
    """For angles: "paper" (4 facets), or a number of facets."""


class Grid(Section):
    """Longest spacing of the nodes, and further nodes; burns and window edges are always nodes."""

    step_max_s: Annotated[float, Field(ge=1, le=1e7)]
    """Longest spacing of the nodes in s."""
    nodes_s: Annotated[tuple[FlightTime, ...], Field(max_length=1000)] = ()
    """Further nodes, in s past the epoch."""


class Scenario(Section):
    """Everything that defines a planning problem."""

    name: Name
    """Name of the scenario, for tables, figures and folders."""
    epoch: Epoch
    body: Body
    sun: Sun
    site: SiteSection
    spacecraft: Spacecraft
    boundary: Boundary
    burns: Burns
    observation: Observation
    safety: Safety
    battery: Battery
    schedule: ScheduleRules
    uncertainty: Uncertainty
    navigation: Navigation = Navigation()
    policy: Policy = Policy()
    knowledge: Knowledge | None = None
    """How well body, site and spacecraft are known; all of it is known if left out."""
    risk: Risk
    polytopes: PolytopeSection
    grid: Grid
    in_flight: InFlight | None = None
    """State after the burns flown, of a flight that is under way; the whole flight if left out."""
    design: Design | None = None
    """Choices of a design; planning itself takes burns and phases as they are."""

    @model_serializer(mode="wrap")
    def _what_is_given(self, handler: SerializerFunctionWrapHandler) -> dict[str, Any]:
        """Leave out empty tables, so that older scenarios are written as before."""
        empty = {"navigation": Navigation(), "policy": Policy()}
        return {k: v for k, v in handler(self).items() if getattr(self, k) != empty.get(k, ...)}

    def __repr__(self) -> str:
        """One line; `print` shows every entry."""
        burns = len(self.burns.times_s)
        return f"<Scenario {self.name}: {self.body.name}, site {self.site.name}, {burns} burns>"

    @property
    def duration_s(self) -> float:
        """Time of the last burn."""
        return self.burns.times_s[-1]

    @property
    def start_s(self) -> float:
        """Time in s at which planning begins: the epoch, or that of the state in flight."""
        return 0.0 if self.in_flight is None else self.in_flight.at_s

    @property
    def burns_flown(self) -> int:
        """Burns at or before the state in flight."""
        return 0 if self.in_flight is None else sum(t <= self.start_s for t in self.burns.times_s)

    @property
    def burn_times_s(self) -> tuple[float, ...]:
        """Firing times of the burns to be planned, s."""
        return self.burns.times_s[self.burns_flown :]

    @classmethod
    def validated(cls, data: Mapping[str, Any]) -> Self:
        """A scenario from nested tables.

        Raises:
            InputError: naming the entry, what was given and what is allowed.
        """
        try:
            return cls.model_validate_json(json.dumps(data, default=str))
        except ValidationError as error:
            raise input_error(error, cls) from None
        except (ValueError, RecursionError) as error:  # a number or a nesting beyond all bounds
            raise InputError("scenario", "values that cannot be read", str(error)[:120]) from None

    def replace(self, changes: Mapping[str, Any]) -> Self:
        """The same scenario with other values, and everything computed from them.

        Args:
            changes: values by entry, `{"risk.p_chance": 0.8}`, or nested as in the file.

        Raises:
            InputError: naming the entry, what was given and what is allowed.
        """
        if not isinstance(changes, Mapping):
            raise InputError("changes", shortened(changes), 'must be as {"risk.p_chance": 0.8}')
        layer = tables_of(changes.items())
        data = inherit(self.model_dump(mode="json", exclude_none=True), layer)
        return self.validated(derive(data, layer))
