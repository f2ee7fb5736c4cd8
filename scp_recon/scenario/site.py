"""The table `[site]`: what is observed, by position and normal or by latitude and longitude."""

from __future__ import annotations

from typing import Annotated, Self

from pydantic import Field, model_validator

from scp_recon.scenario.fields import Name, NonZeroVector, Positive, Section, Vector


class SiteSection(Section):
    """What is observed; body-fixed."""

    name: Name
    """Name of the site, for tables and figures."""
    position_body_m: Vector
    """Position in m from the centre of mass, body-fixed. Follows from latitude and longitude."""
    normal_body: NonZeroVector
    """Outward normal, body-fixed, of any length. Follows from the shape where it is not given."""
    latitude_deg: Annotated[float, Field(ge=-90, le=90)] | None = None
    """Planetocentric latitude in deg: of the position vector above the equator, north positive."""
    longitude_deg: Annotated[float, Field(ge=-360, le=360)] | None = None
    """East longitude in deg from the prime meridian, body-fixed."""
    normal_radius_m: Positive | None = None
    """Average the normal over the facets of body.shape_file whose centre is this near, in m."""

    @model_validator(mode="after")
    def _both_coordinates(self) -> Self:
        if (self.latitude_deg is None) != (self.longitude_deg is None):
            raise ValueError("must have latitude_deg and longitude_deg together")
        return self
