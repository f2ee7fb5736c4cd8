"""Resolve gravity and light pressure, of the planner and of flights that test plans; J2000, SI."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import Literal

import numpy as np

from scp_recon.bodies.catalogue import AU_KM, packaged_body
from scp_recon.bodies.surface import Ellipsoid, Mesh
from scp_recon.display import exact
from scp_recon.errors import InputError, option
from scp_recon.mission.scene import Scene
from scp_recon.physics.forces import ForceModel, cannonball_srp
from scp_recon.physics.harmonics import HarmonicField, TurningField
from scp_recon.physics.polyhedron import PolyhedronField
from scp_recon.scenario.body import Body
from scp_recon.scenario.schema import Scenario

TruthModel = Literal["planner", "harmonics", "polyhedron"]
"""Gravity with which flights are flown: the plan's, all harmonics, or the homogeneous solid's."""
HARMONICS_DEGREE = 8
"""Degree of the packaged field: the paper's ground truth."""
FIELD_BODY = "Bennu"
"""Body of the packaged field: Chesley et al. 2020."""
SAME_GM, SAME_J2 = 0.01, 0.1
"""How far a scenario's GM and J2 may be off the packaged field's, relative."""


@dataclass(frozen=True, eq=False)
class Gravity:
    """Forces of the planner, and of flights with another gravity.

    Attributes:
        scene: where they act; with a deviation, forces have the parameters of its flights.
    """

    scene: Scene

    @cached_property
    def planned(self) -> ForceModel:
        """Forces of the planner."""
        return self._deviating(forces_of(self.scene, planned_field(self.scene.scenario)))

    def forces(self, truth: TruthModel) -> ForceModel:
        """Forces of flights: the planner's, or with another gravity.

        Raises:
            InputError: if the body has no field, or its shape is not known.
        """
        if truth == "planner":
            return self.planned
        if truth == "harmonics":
            found = forces_of(self.scene, self.harmonics)
        else:
            gm, solid = self.scene.scenario.body.gm_m3_s2, self.solid
            field = PolyhedronField(gm, solid.vertices_m, solid.facets)
            turning, point = TurningField(field, self.scene.rotation), forces_of(self.scene, None)
            found = replace(point, gm=0.0, j2_strength=0.0, field=turning)
        return self._deviating(found)

    def _deviating(self, forces: ForceModel) -> ForceModel:
        deviation = self.scene.deviation
        return deviation.forces(forces, self.scene.scenario) if deviation else forces

    def in_words(self, truth: TruthModel = "planner") -> str:
        """The gravity of the planner, or of flights, with its rotation and the companion."""
        body = self.scene.scenario.body
        own = "point mass and J2" if body.j2 else "point mass"
        if truth == "harmonics":
            own = f"harmonics to degree {len(self.harmonics.c) - 1}"
        elif truth == "polyhedron":
            own = f"a homogeneous polyhedron of {len(self.solid.facets)} facets"
        elif body.planned_degree is not None:
            of = " of a homogeneous solid" if is_planned_as_solid(body) else ""
            own = f"harmonics{of} to degree {body.planned_degree}"
        if body.attitude is not None:
            own += " that tumble with the body"
        return own if body.companion is None else f"{own}, and the pull of {body.companion.name}"

    @cached_property
    def solid(self) -> Mesh:
        """The body as a homogeneous polyhedron; errors as `solid_of`."""
        return solid_of(self.scene.scenario.body)

    @cached_property
    def harmonics(self) -> HarmonicField:
        """Field of the true dynamics, against which J2 is tested; errors as `truth_field`."""
        return truth_field(self.scene.scenario)


def forces_of(scene: Scene, field: HarmonicField | None) -> ForceModel:
    """Forces with a gravity field, SI, J2000; without one that of a point mass and J2."""
    body, craft, sun = scene.scenario.body, scene.scenario.spacecraft, scene.scenario.sun
    tumbles = body.attitude is not None
    if tumbles and field is None:  # J2 has a closed form about a fixed axis alone
        field = HarmonicField.zonal(body.gm_m3_s2, body.reference_radius_m, body.j2)
    j2, radius = (body.j2, body.reference_radius_m) if field is None else (field.j2, field.radius)
    closed = (0,) if tumbles else (0, 2)
    return ForceModel(
        gm=body.gm_m3_s2,
        j2_strength=0.0 if tumbles else 1.5 * body.gm_m3_s2 * j2 * radius**2,
        pole=scene.rotation.pole.T,
        field=None if field is None else TurningField(field.beside(*closed), scene.rotation),
        companion=scene.companion,
        srp=cannonball_srp(
            scene.sun_direction(0.0),
            craft.srp_area_m2,
            craft.reflectivity_coefficient,
            craft.mass_kg,
            float(np.linalg.norm(sun.body_position_km)) / AU_KM,
            sun.solar_constant_w_m2,
        ),
    )


def planned_field(scenario: Scenario) -> HarmonicField | None:
    """The field to `body.planned_degree`, SI; None where the point mass and J2 are planned with.

    Raises:
        InputError: as `truth_field`, and if the body's field has no such degree.
    """
    body, degree = scenario.body, scenario.body.planned_degree
    if degree is None:
        return None
    if is_planned_as_solid(body):
        mesh = solid_of(body, PLANNED)
        return HarmonicField.of_solid(mesh, body.gm_m3_s2, body.reference_radius_m, degree)
    field = truth_field(scenario, PLANNED)
    most = len(field.c) - 1
    if degree > most:
        raise InputError(PLANNED, str(degree), f"must be at most {most}, the degree of the field")
    return field.up_to(degree)


PLANNED = "body.planned_degree"


def is_planned_as_solid(body: Body) -> bool:
    """Whether the planner's harmonics are those of the homogeneous solid, for lack of a field."""
    known = body.gravity is not None or packaged_body(body.name) is packaged_body(FIELD_BODY)
    return not known and (body.solid is not None or body.radii_m is not None)


def solid_of(body: Body, needed_by: str = option("truth", "polyhedron")) -> Mesh:
    """The body as a homogeneous polyhedron: that of `body.solid_file`, else the ellipsoid's.

    Raises:
        InputError: if the body has neither.
    """
    if body.solid is not None:
        return Mesh(np.array(body.solid.vertices_m), np.array(body.solid.facets, dtype=np.intp))
    if body.radii_m is None:
        allowed = f"must name a shape model, or body.radii_m be given, for {needed_by}"
        raise InputError("body.solid_file", "nothing", allowed)
    return Ellipsoid(np.array(body.radii_m)).tessellated(HALVINGS)


HALVINGS = 3
"""Of the octahedron that becomes an ellipsoid: 512 facets. Of Itokawa's, at 500 m, 3e-4 of the pull is
lost by that."""


def truth_field(scenario: Scenario, needed_by: str = option("truth", "harmonics")) -> HarmonicField:
    """The field of `body.gravity_file` in full, else that of the packaged body to degree 8; SI.

    Raises:
        InputError: if the body has neither, or its GM, reference radius or J2 differs from the
            packaged field's.
    """
    body = scenario.body
    if body.gravity is not None:
        rows = body.gravity.coefficients
        degree = max(n for n, _, _, _ in rows)
        return HarmonicField.of_rows(body.gm_m3_s2, body.gravity.reference_radius_m, degree, rows)
    if packaged_body(body.name) is packaged_body(FIELD_BODY):
        known = packaged_body(FIELD_BODY)
        assert known is not None
        for entry, share in (("gm_m3_s2", SAME_GM), ("reference_radius_m", 0.0), ("j2", SAME_J2)):
            given, own = getattr(body, entry), known.entries[entry]
            if abs(given - own) > share * own:
                within = f"within {100 * share:g} % of " if share else ""
                needs = f"must be {within}{own:g}: the packaged gravity field is {FIELD_BODY}'s"
                raise InputError(needed_by, f"body.{entry} {exact(given)}", needs)
        return HarmonicField.bennu(body.gm_m3_s2, HARMONICS_DEGREE)
    needs = f"must name a gravity field (.gfc, or a PDS SHA table) for {needed_by}"
    raise InputError("body.gravity_file", f"nothing for {body.name}", needs)
