"""Surfaces: latitude and longitude to position and normal, and back."""

import itertools
import re
from pathlib import Path

import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from formulations.arrays import Array
from scp_recon.bodies.files import read_shape
from scp_recon.bodies.surface import (
    Ellipsoid,
    Mesh,
    OpenShapeError,
    Solid,
    coordinates_of,
    direction_of,
)
from scp_recon.errors import InputError
from tests.helpers import generators
from tests.scp_recon.support import refusal

latitudes, longitudes = st.floats(-90.0, 90.0), st.floats(-180.0, 180.0)
radii = st.tuples(*[st.floats(10.0, 1e5)] * 3).map(np.array)


def box(half: Array) -> Mesh:
    """A box as twelve triangles, turning outward."""
    corners = np.array(list(itertools.product((-1.0, 1.0), repeat=3))) * half
    facets = []
    for axis, side in itertools.product(range(3), (0, 1)):
        one, two = (axis + 1) % 3, (axis + 2) % 3
        order = [(0, 0), (1, 0), (1, 1), (0, 1)]
        quad = [side << (2 - axis) | i << (2 - one) | j << (2 - two) for i, j in order]
        quad = quad if side else quad[::-1]
        facets += [(quad[0], quad[1], quad[2]), (quad[0], quad[2], quad[3])]
    return Mesh(corners, np.array(facets))


def write_obj(path: Path, mesh: Mesh) -> Path:
    lines = ["# a shape", *("v {!r} {!r} {!r}".format(*v) for v in mesh.vertices_m.tolist())]
    lines += ["f {}/1/1 {}/2/1 {}/3/1".format(*f) for f in (mesh.facets + 1).tolist()]
    path.write_text("\n".join(lines), "utf-8")
    return path


@given(radii=radii, latitude=latitudes, longitude=longitudes)
def test_ellipsoid_positions_have_the_asked_coordinates(radii, latitude, longitude):
    position, normal = Ellipsoid(radii).at(direction_of(latitude, longitude))
    found = coordinates_of(position)
    np.testing.assert_allclose(direction_of(*found), direction_of(latitude, longitude), atol=1e-12)
    assert found[0] == pytest.approx(latitude, abs=1e-6)
    assert np.linalg.norm(position / radii) == pytest.approx(1.0, rel=1e-12)
    assert np.linalg.norm(normal) == pytest.approx(1.0, rel=1e-12)
    assert normal @ position > 0.0


@given(radii=radii, latitude=latitudes, longitude=longitudes, turn=st.floats(0.0, 6.3))
def test_ellipsoid_lies_below_its_tangent_plane(radii, latitude, longitude, turn):
    # Every other point of a convex body is below the tangent plane.
    position, normal = Ellipsoid(radii).at(direction_of(latitude, longitude))
    other, _ = Ellipsoid(radii).at(direction_of(np.rad2deg(np.sin(turn)), 50.0 * turn))
    assert (other - position) @ normal <= 1e-9 * radii.max()


@given(half=radii, latitude=latitudes, longitude=longitudes)
def test_rays_leave_a_box_by_the_last_side(half, latitude, longitude):
    direction = direction_of(latitude, longitude)
    share = np.abs(direction) / half
    assume(np.sort(share)[-1] > 1.001 * np.sort(share)[-2])
    position, normal = box(half).at(direction)
    np.testing.assert_allclose(position, direction / share.max(), rtol=1e-9, atol=1e-9)
    axis = int(np.argmax(share))
    np.testing.assert_allclose(normal, np.sign(direction[axis]) * np.eye(3)[axis], atol=1e-12)


@given(latitude=latitudes, longitude=longitudes)
def test_outermost_shell_is_the_surface(latitude, longitude):
    inner, outer = box(np.full(3, 50.0)), box(np.full(3, 80.0))
    facets = np.concatenate([outer.facets + 8, inner.facets])
    both = Mesh(np.concatenate([inner.vertices_m, outer.vertices_m]), facets[:, ::-1])
    direction = direction_of(latitude, longitude)
    position, normal = both.at(direction)
    np.testing.assert_allclose(position, outer.at(direction)[0], rtol=1e-9)
    assert normal @ direction > 0.0


def test_normals_are_averaged_by_area_within_the_radius():
    cube = box(np.full(3, 10.0))
    everywhere = Mesh(cube.vertices_m, cube.facets, 16.0)
    _, alone = cube.at(direction_of(5.0, 3.0))
    _, averaged = everywhere.at(direction_of(44.0, 1.0))
    np.testing.assert_allclose(alone, [1.0, 0.0, 0.0], atol=1e-12)
    assert averaged[0] == pytest.approx(averaged[2], rel=0.5)  # two sides of the edge
    assert np.linalg.norm(averaged) == pytest.approx(1.0)


def test_open_mesh_has_no_site_in_the_hole():
    cube = box(np.full(3, 10.0))
    with pytest.raises(OpenShapeError):
        Mesh(cube.vertices_m, cube.facets[:-2]).at(np.array([0.0, 0.0, 1.0]))


def test_obj_units_polygons_and_relative_indices_are_read(tmp_path):
    cube = box(np.full(3, 2.0))
    file = write_obj(tmp_path / "box.obj", cube)
    np.testing.assert_array_equal(read_shape(file, "m").vertices_m, cube.vertices_m)
    np.testing.assert_array_equal(read_shape(file, "km").vertices_m, 1000.0 * cube.vertices_m)
    np.testing.assert_array_equal(read_shape(file, "m").facets, cube.facets)
    vertices = "".join("v {} {} {}\n".format(*v) for v in cube.vertices_m)
    quads = "f -8 -7 -5 -6  # a side \nf 5 7 8 6\nf 1 5 6 2\nf 3 4 8 7\nf 1 3 7 5\nf 2 6 8 4\n"
    (tmp_path / "quads.obj").write_text(vertices + quads, "utf-8")
    quadrangles = read_shape(tmp_path / "quads.obj", "m")
    assert len(quadrangles.facets) == 12
    direction = direction_of(20.0, 200.0)
    np.testing.assert_allclose(quadrangles.at(direction)[0], cube.at(direction)[0])


BALL = Ellipsoid(np.array([300.0, 200.0, 150.0])).tessellated(2)


@given(share=st.floats(0.0, 0.45), rng=generators, inward=st.booleans(), seam=st.booleans())
def test_flipped_facets_are_turned_as_most_are(share, rng, inward, seam, tmp_path_factory):
    """Also where vertices stand twice, and where a second surface is inside."""
    facets = BALL.facets[:, ::-1] if inward else BALL.facets
    both = np.concatenate([facets, facets + len(BALL.vertices_m)])
    vertices = np.concatenate([BALL.vertices_m, 0.5 * BALL.vertices_m])
    if seam:
        vertices, both = vertices[both].reshape(-1, 3), np.arange(both.size).reshape(-1, 3)
    flipped = rng.permutation(len(both)) < share * len(both)
    flipped[: len(facets)] &= rng.random(len(facets)) < 0.9
    mixed = np.where(flipped[:, None], both[:, ::-1], both)
    assume(all(2 * np.sum(part) < len(part) for part in np.split(flipped, 2)))
    file = write_obj(tmp_path_factory.getbasetemp() / "mixed.obj", Mesh(vertices, mixed))
    np.testing.assert_array_equal(read_shape(file, "m").facets, both)


@pytest.mark.parametrize("facet", [0, 17, 127])
@pytest.mark.parametrize("twice", [False, True])
def test_open_shape_is_refused_with_a_facets_line(facet, twice, tmp_path):
    """A facet is missing, or there twice."""
    without = np.delete(BALL.facets, facet, axis=0)
    facets = np.concatenate([BALL.facets, BALL.facets[[facet]]]) if twice else without
    file = write_obj(tmp_path / "open.obj", Mesh(BALL.vertices_m, facets))
    with pytest.raises(InputError, match="must be closed") as caught:
        read_shape(file, "m")
    line = int(re.search(r"line (\d+): an edge", caught.value.given)[1])
    corners = {
        int(word.split("/")[0]) - 1
        for word in file.read_text("utf-8").split("\n")[line - 1].split()[1:]
    }
    assert len(corners & {*BALL.facets[facet].tolist()}) >= 2


@pytest.mark.parametrize("facet", [0, 17, 127])
def test_degenerate_facet_is_named_by_its_own_line(facet, tmp_path):
    facets = BALL.facets.copy()
    facets[facet, 1] = facets[facet, 0]
    file = write_obj(tmp_path / "flat.obj", Mesh(BALL.vertices_m, facets))
    lines = file.read_text("utf-8").split("\n")
    own = [n for n, line in enumerate(lines, start=1) if line.startswith("f")][facet]
    with pytest.raises(InputError, match=f"line {own}: a side of no length"):
        read_shape(file, "m")


@pytest.mark.parametrize(
    "text",
    [
        "",
        "v 1 2 3\n",
        "v 1 2\n",
        "v a b c\n",
        "f 1 x 2\n",
        "v nan 0 0\n" * 4,
        "v 1 0 0\nv 0 1 0\nv 0 0 1\nv 0 0 0\nf 1 2 99999999999999999999\nf 1 2 3\nf 1 3 4\nf 2 3 4\n",
    ],
)
def test_unreadable_shapes_are_refused_in_one_message(text, tmp_path):
    (tmp_path / "no.obj").write_text(text, "utf-8")
    error = refusal(read_shape, tmp_path / "no.obj", "m")
    assert error.entry.startswith("body.shape_file")


def test_an_obj_without_a_unit_is_refused(tmp_path):
    file = write_obj(tmp_path / "box.obj", box(np.full(3, 2.0)))
    with pytest.raises(InputError, match="shape_unit"):
        read_shape(file, None)


anywhere = st.tuples(*[st.floats(-1e3, 1e3)] * 3).map(np.array)


@given(half=radii, centre=anywhere, turn=st.integers(0, 1000))
def test_box_has_known_volume_centre_and_inertia(half, centre, turn):
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


def test_inward_facets_have_negative_volume_and_same_centre():
    mesh = box(np.array([3.0, 2.0, 1.0]))
    inward = Solid.of(Mesh(mesh.vertices_m + 5.0, mesh.facets[:, ::-1]))
    assert inward.volume_m3 == pytest.approx(-48.0)
    np.testing.assert_allclose(inward.centre_m, 5.0)
    assert inward.radius_m == pytest.approx(2.2545, rel=1e-4)


def test_a_sheet_has_no_volume():
    mesh = box(np.array([3.0, 2.0, 1.0]))
    with pytest.raises(ValueError, match="no volume"):
        Solid.of(Mesh(mesh.vertices_m * [1.0, 1.0, 0.0], mesh.facets))
