"""What is inside a mesh, against boxes and ellipsoids by formula."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial import ConvexHull
from scipy.spatial.transform import Rotation

from scp_recon.environment.solid import Solid
from scp_recon.environment.surface import Mesh
from tests.scp_recon.environment.test_surface import box

halves = st.tuples(*[st.floats(10.0, 1e5)] * 3).map(np.array)
anywhere = st.tuples(*[st.floats(-1e3, 1e3)] * 3).map(np.array)


@given(half=halves, centre=anywhere, turn=st.integers(0, 1000))
def test_a_box_has_the_volume_centre_and_inertia_of_a_box(
    half: np.ndarray, centre: np.ndarray, turn: int
) -> None:
    """Wherever it is and however it is turned: m (b^2 + c^2) / 3 about an axis through its centre."""
    axes = Rotation.random(random_state=turn).as_matrix()
    mesh = box(half)
    solid = Solid.of(Mesh(mesh.vertices_m @ axes.T + centre, mesh.facets))
    size = float(half.max() + np.linalg.norm(centre))
    assert solid.volume_m3 == pytest.approx(8.0 * half.prod(), rel=1e-3)
    np.testing.assert_allclose(solid.centre_m, centre, atol=1e-6 * size)
    about = (half @ half - half**2) / 3.0
    expected = axes @ np.diag(about) @ axes.T
    np.testing.assert_allclose(solid.inertia_m2, expected, atol=1e-6 * size**2)


def test_facets_that_turn_inward_have_a_negative_volume_and_the_same_centre() -> None:
    mesh = box(np.array([3.0, 2.0, 1.0]))
    inward = Solid.of(Mesh(mesh.vertices_m + 5.0, mesh.facets[:, ::-1]))
    assert inward.volume_m3 == pytest.approx(-48.0)
    np.testing.assert_allclose(inward.centre_m, 5.0)
    assert inward.radius_m == pytest.approx(2.2545, rel=1e-4)


def test_a_sheet_has_no_volume() -> None:
    mesh = box(np.array([3.0, 2.0, 1.0]))
    with pytest.raises(ValueError, match="no volume"):
        Solid.of(Mesh(mesh.vertices_m * [1.0, 1.0, 0.0], mesh.facets))


def test_a_fine_mesh_is_its_ellipsoid() -> None:
    """m (b^2 + c^2) / 5 about an axis."""
    radii = np.array([283.0, 271.0, 250.0])
    points = np.random.default_rng(0).normal(size=(6000, 3))
    points /= np.linalg.norm(points, axis=1, keepdims=True)
    hull = ConvexHull(points)
    outward = np.linalg.det(points[hull.simplices]) > 0.0
    facets = np.where(outward[:, None], hull.simplices, hull.simplices[:, ::-1])
    solid = Solid.of(Mesh(points * radii, facets))
    np.testing.assert_allclose(
        np.diag(solid.inertia_m2), (radii @ radii - radii**2) / 5.0, rtol=5e-3
    )
