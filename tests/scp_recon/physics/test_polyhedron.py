"""A homogeneous polyhedron against the ellipsoid's closed form, Poisson's equation, its harmonics."""

import numpy as np
import pytest
from scipy.optimize import brentq
from scipy.special import elliprd

from formulations.arrays import Array
from scp_recon.bodies.surface import Ellipsoid, Mesh, Solid
from scp_recon.physics.harmonics import HarmonicField, PolyhedronField

RADII, GM = np.array([304.68, 136.60, 114.21]), 2.34
CUBE = Ellipsoid(np.ones(3)).tessellated(0)
LOPSIDED = Mesh(np.array([[0, 0, 0], [300, 0, 0], [0, 200, 0], [0, 0, 100.0]]), CUBE.facets[:0])
TETRAHEDRON = Mesh(
    LOPSIDED.vertices_m - np.array([75.0, 50.0, 25.0]),
    np.array([[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]]),
)


def field(mesh: Mesh) -> PolyhedronField:
    return PolyhedronField(GM, mesh.vertices_m, mesh.facets)


def around(radius: float, number: int = 20) -> Array:
    """Positions at a distance, m, shape (3, number)."""
    way = np.random.default_rng(1).standard_normal((3, number))
    return radius * way / np.linalg.norm(way, axis=0)


def of_ellipsoid(position: Array) -> Array:
    """Pull of the homogeneous ellipsoid outside, by Carlson's integrals: Binney & Tremaine, 2.5.3."""

    def outside(k: float) -> float:
        return float((position**2 / (RADII**2 + k)).sum() - 1.0)

    a, b, c = RADII**2 + brentq(outside, 0.0, 1e8, xtol=1e-9)
    shares = np.array([elliprd(b, c, a), elliprd(c, a, b), elliprd(a, b, c)])
    return -GM * shares * position


@pytest.mark.parametrize(("halvings", "within"), [(2, 4e-3), (3, 8e-4), (4, 2e-4)])
def test_finer_facets_come_to_the_ellipsoids_closed_form(halvings, within):
    mesh = Ellipsoid(RADII).tessellated(halvings)
    assert (len(mesh.facets), len(mesh.vertices_m)) == (8 * 4**halvings, 4 * 4**halvings + 2)
    assert Solid.of(mesh).volume_m3 == pytest.approx(4.0 / 3.0 * np.pi * RADII.prod(), rel=1e-12)
    positions = around(400.0)
    exact = np.array([of_ellipsoid(each) for each in positions.T]).T
    off = np.linalg.norm(field(mesh).derivatives(positions, 0) - exact, axis=0)
    assert (off / np.linalg.norm(exact, axis=0)).max() < within


def test_pull_obeys_poissons_equation():
    """Poisson's equation: the divergence is -4 pi G rho inside, and none outside; nowhere a curl."""
    solid, step = field(TETRAHEDRON), 0.01
    density = GM / Solid.of(TETRAHEDRON).volume_m3
    for position, inside in ((np.array([-50.0, -30.0, -15.0]), True), (np.full(3, 150.0), False)):
        moved = position[:, None] + step * np.hstack([np.eye(3), -np.eye(3)])
        pulls = solid.derivatives(moved, 0)
        gradient = (pulls[:, :3] - pulls[:, 3:]) / (2.0 * step)
        size = np.abs(gradient).max()
        np.testing.assert_allclose(gradient, gradient.T, atol=1e-6 * size)
        sources = -4.0 * np.pi * density if inside else 0.0
        assert np.trace(gradient) == pytest.approx(sources, rel=1e-6, abs=1e-6 * size)


@pytest.mark.parametrize("mesh", [TETRAHEDRON, Ellipsoid(RADII).tessellated(2)])
def test_its_harmonics_are_its_pull_outside(mesh):
    positions = around(1200.0)
    pull = field(mesh).derivatives(positions, 0)
    size = np.linalg.norm(pull, axis=0).max()
    for degree, within in ((8, 2e-5), (18, 1e-9)):
        outside = HarmonicField.of_solid(mesh, GM, 300.0, degree)
        np.testing.assert_allclose(outside.derivatives(positions, 0), pull, atol=within * size)
    assert outside.j2 * 300.0**2 == pytest.approx(_oblateness(mesh), rel=1e-12)


def _oblateness(mesh: Mesh) -> float:
    """J2 R^2, m^2, of the moments of inertia."""
    x, y, z = np.diag(Solid.of(mesh).inertia_m2)
    return float(z - 0.5 * (x + y))


def test_polyhedron_scales_and_refuses_higher_orders():
    solid, positions = field(TETRAHEDRON), around(500.0)
    scaled = solid.in_units(1000.0, 3600.0).derivatives(positions / 1000.0, 0)
    np.testing.assert_allclose(
        scaled, solid.derivatives(positions, 0) * 3600.0**2 / 1000.0, rtol=1e-9
    )
    np.testing.assert_array_equal(solid.acceleration(*positions), solid.derivatives(positions, 0))
    with pytest.raises(ValueError, match="expected order 0"):
        solid.derivatives(positions, 1)


def test_esas_library_pulls_alike():
    """Schuhmacher et al. 2024, by Tsoulis's line integrals."""
    library = pytest.importorskip("polyhedral_gravity")
    mesh = Ellipsoid(RADII).tessellated(3)
    density = GM / Solid.of(mesh).volume_m3 / 6.67430e-11
    positions = around(330.0)
    outward, unchecked = library.NormalOrientation.OUTWARDS, library.PolyhedronIntegrity.DISABLE
    body = library.Polyhedron((mesh.vertices_m, mesh.facets), density, outward, unchecked)
    theirs = library.GravityEvaluable(body)(positions.T, False)
    pulls = np.array([pull for _, pull, _ in theirs]).T
    np.testing.assert_allclose(field(mesh).derivatives(positions, 0), pulls, rtol=1e-9)
