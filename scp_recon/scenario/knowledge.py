"""Define the table `[knowledge]`: how well body, site and spacecraft are known."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Annotated, Any, Self

import numpy as np
from pydantic import Field, model_validator

from formulations.arrays import Array
from scp_recon.scenario.fields import Component, Line, NonNegative, Sparse, walk
from scp_recon.scenario.uncertainty import check_covariance

Sigmas = tuple[NonNegative, NonNegative, NonNegative]


class KnownCompanion(Sparse):
    """1-sigma errors of the companion."""

    gm_m3_s2: NonNegative | None = None
    """1 sigma of body.companion.gm_m3_s2 in m^3/s^2."""
    mean_anomaly_deg: NonNegative | None = None
    """1 sigma of the companion's phase, body.companion.mean_anomaly_deg, in deg."""


class KnownBody(Sparse):
    """1-sigma errors of the body."""

    gm_m3_s2: NonNegative | None = None
    """1 sigma of GM in m^3/s^2; harmonics keep their ratio to it."""
    j2: NonNegative | None = None
    """1 sigma of the unnormalised J2 at reference_radius_m."""
    pole_ra_deg: NonNegative | None = None
    """1 sigma of the pole's right ascension in deg."""
    pole_dec_deg: NonNegative | None = None
    """1 sigma of the pole's declination in deg."""
    prime_meridian_deg: NonNegative | None = None
    """1 sigma in deg of the spin's phase at the epoch, hence of all longitudes."""
    prime_meridian_rate_deg_day: NonNegative | None = None
    """1 sigma in deg/day of the spin rate, about the phase at the epoch."""
    companion: KnownCompanion | None = None
    """1 sigma of the companion's parameters."""


class KnownSpacecraft(Sparse):
    """1-sigma errors of the cannonball."""

    srp_area_m2: NonNegative | None = None
    """1 sigma of the area that the Sun lights in m^2."""
    reflectivity_coefficient: NonNegative | None = None
    """1 sigma of C_R."""


class KnownSite(Sparse):
    """1-sigma errors of the site, body-fixed."""

    position_body_m: Sigmas | None = None
    """1 sigma of each component of the site's position in m."""
    normal_body: Sigmas | None = None
    """1 sigma of each component of its unit normal: across the normal they are rad."""


SIZES = {"site.position_body_m": 3, "site.normal_body": 3}
"""Number of components of entries that have several."""


class Knowledge(Sparse):
    """1-sigma errors of what a flight cannot change, named and in the unit of the scenario's entries.

    They are constant in a flight, normal, and independent of all other errors; of each other too, but
    for those of `names`, which have a covariance. Without this table all of it is known.
    """

    body: KnownBody | None = None
    """1 sigma of the body's parameters."""
    spacecraft: KnownSpacecraft | None = None
    """1 sigma of the spacecraft's parameters."""
    site: KnownSite | None = None
    """1 sigma of the site's position and normal."""
    names: Annotated[tuple[Line, ...], Field(min_length=2, max_length=20)] | None = None
    """Entries of the scenario that have a covariance, such as body.gm_m3_s2; vectors count three."""
    covariance: tuple[tuple[Component, ...], ...] | None = None
    """Covariance of names, in the entries' units."""

    @model_validator(mode="after")
    def _covariance_of_names(self) -> Self:
        if (self.names is None) != (self.covariance is None):
            raise ValueError("must have names and covariance together")
        if self.names is None or self.covariance is None:
            return self
        allowed = sorted(ENTRIES)
        if unknown := [name for name in self.names if name not in ENTRIES]:
            raise ValueError(f"names must be among {', '.join(allowed)}; not {unknown[0]}")
        if twice := [n for n, _ in self.sigmas() if n in self.names]:
            raise ValueError(f"must give {twice[0]} once, as a sigma or in the covariance")
        if len(set(self.names)) < len(self.names):
            raise ValueError("names must differ")
        size = sum(SIZES.get(name, 1) for name in self.names)
        if [len(row) for row in self.covariance] != size * [size]:
            raise ValueError(f"covariance must have {size} rows of {size} numbers, as names say")
        try:
            check_covariance(self.covariance)
        except ValueError as error:
            raise ValueError(f"covariance {error}") from None
        return self

    def sigmas(self) -> Iterator[tuple[str, Array]]:
        """Entries given by their sigmas, with these, shape (1,) or (3,)."""
        for entry in ENTRIES:
            value: Any = self
            for key in entry.split("."):
                value = None if value is None else getattr(value, key)
            if value is not None:
                yield entry, np.atleast_1d(np.array(value, dtype=float))


ENTRIES = tuple(path for path, table in walk(Knowledge) if table is None and "." in path)
"""Entries of the scenario that may be uncertain."""
