"""What a scenario is: its tables, validated together."""

from __future__ import annotations

import json
from collections.abc import Mapping
from typing import Any, Self

from pydantic import ValidationError

from scp_recon.errors import InputError
from scp_recon.scenario.body import Body, Sun
from scp_recon.scenario.fields import Name, Section
from scp_recon.scenario.home import Design
from scp_recon.scenario.in_flight import InFlight
from scp_recon.scenario.inherit import inherit, merge, nested
from scp_recon.scenario.messages import input_error
from scp_recon.scenario.resolve import resolve
from scp_recon.scenario.sections import (
    Battery,
    Boundary,
    Burns,
    Epoch,
    Grid,
    Observation,
    PolytopeSection,
    Risk,
    Safety,
    ScheduleRules,
    Spacecraft,
)
from scp_recon.scenario.site import SiteSection
from scp_recon.scenario.uncertainty import Uncertainty


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
    risk: Risk
    polytopes: PolytopeSection
    grid: Grid
    in_flight: InFlight | None = None
    """State after the burns flown, of a flight that is under way; the whole flight if left out."""
    design: Design | None = None
    """What a design may choose; planning itself takes burns and phases as they are."""

    @property
    def duration_s(self) -> float:
        """Time of the last burn."""
        return self.burns.times_s[-1]

    @property
    def start_s(self) -> float:
        """Time from which on there is something to plan: the epoch, or that of the state in flight."""
        return 0.0 if self.in_flight is None else self.in_flight.at_s

    @property
    def burns_flown(self) -> int:
        """Burns at or before the state in flight."""
        return 0 if self.in_flight is None else sum(t <= self.start_s for t in self.burns.times_s)

    @property
    def burn_times_s(self) -> tuple[float, ...]:
        """Firing times of the burns that are to be planned."""
        return self.burns.times_s[self.burns_flown :]

    def same_but_in_flight(self, other: Scenario) -> bool:
        """Whether another scenario differs in where a flight is at most."""
        alone = {"in_flight": None}
        return self.model_copy(update=alone) == other.model_copy(update=alone)

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
        """The same scenario with other values.

        Args:
            changes: values by entry, `{"risk.p_chance": 0.8}`, or nested as in the file.

        Raises:
            InputError: naming the entry, what was given and what is allowed.
        """
        layer: dict[str, Any] = {}
        for entry, value in changes.items():
            layer = merge(layer, nested(entry.split("."), value))
        return self.changed(layer)

    def changed(self, layer: Mapping[str, Any]) -> Self:
        """The same scenario with what some nested tables say anew, and with what follows from it.

        Raises:
            InputError: naming the entry, what was given and what is allowed.
        """
        data = inherit(self.model_dump(mode="json", exclude_none=True), layer)
        return self.validated(resolve(data, layer))
