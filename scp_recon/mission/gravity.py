"""Make the forces on a spacecraft from a scenario's body and spacecraft, and name their gravity."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from scp_recon.bodies.catalogue import AU_KM
from scp_recon.bodies.surface import Mesh
from scp_recon.mission.scene import Scene, is_planned_as_solid
from scp_recon.physics.forces import ForceModel, cannonball_srp
from scp_recon.physics.harmonics import HarmonicField, TurningField
from scp_recon.physics.polyhedron import PolyhedronField
from scp_recon.scenario.body import Body


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


def solid_forces(scene: Scene, solid: Mesh) -> ForceModel:
    """Forces with the gravity of a homogeneous polyhedron."""
    field = PolyhedronField(scene.scenario.body.gm_m3_s2, solid.vertices_m, solid.facets)
    turning = TurningField(field, scene.rotation)
    return replace(forces_of(scene, None), gm=0.0, j2_strength=0.0, field=turning)


def gravity_in_words(body: Body, field: HarmonicField | None, solid: Mesh | None) -> str:
    """A true field or solid, else the planner's gravity, with its rotation and the companion."""
    own = "point mass and J2"
    if field is not None:
        own = f"harmonics to degree {len(field.c) - 1}"
    elif solid is not None:
        own = f"a homogeneous polyhedron of {len(solid.facets)} facets"
    elif body.planned_degree is not None:
        of = " of a homogeneous solid" if is_planned_as_solid(body) else ""
        own = f"harmonics{of} to degree {body.planned_degree}"
    if body.attitude is not None:
        own += " that tumble with the body"
    return own if body.companion is None else f"{own}, and the pull of {body.companion.name}"
