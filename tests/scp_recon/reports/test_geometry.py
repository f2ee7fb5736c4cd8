"""Geometry of the report: against closed forms, SPICE's habits, and the verification."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from scp_recon.bodies.surface import Ellipsoid, Mesh, direction_of
from scp_recon.mission.constraints import companion_distance_m
from scp_recon.physics.frames import unit
from scp_recon.reports.charts import BINS, terminator, thinned
from scp_recon.reports.scene import Frame, companion_of, drifts, keep_sets
from scp_recon.reports.shown import LOOKS, SO_FAR, Camera, Shown
from scp_recon.reports.surfaces import (
    FACETS_MAX,
    RING,
    _of_mesh,
    ellipsoid,
    first_hit,
    shape_of,
    shell,
    tube,
)
from tests.helpers import generators, random_unit
from tests.scp_recon.bodies.test_surface import write_obj
from tests.scp_recon.support import COMPANION, mission_of


@given(generators)
def test_rays_hit_an_ellipsoid_where_the_quadratic_says(rng):
    radii = rng.uniform(100.0, 400.0, 3)
    shape = ellipsoid(radii, "")
    start = 2000.0 * random_unit(rng, 20)
    ray = unit(random_unit(rng, 20) * 250.0 - start)
    found = first_hit(start, ray, shape)
    p, d = start / radii, ray / radii
    a, b, c = (d * d).sum(1), (p * d).sum(1), (p * p).sum(1) - 1.0
    clear = np.abs(b * b - a * c) > 0.05 * b * b  # a graze may fall between two looks
    hits = b * b > a * c
    assert (np.isfinite(found).all(axis=1) == hits)[clear].all()
    along = (-b - np.sqrt(np.maximum(b * b - a * c, 0.0))) / a
    both = hits & clear
    expected = start + along[:, None] * ray
    np.testing.assert_allclose(found[both], expected[both], atol=1e-3)


def test_footprint_subtends_the_camera_angle(shown):
    scenario, mission = shown.solution.scenario, shown.mission
    outlines = shown.outlines_m
    site = mission.site.position_body
    here = shown.fixed(shown.looks_s(LOOKS))
    seen = unit(outlines - here[:, None])
    angle = np.rad2deg(np.arccos(np.einsum("nri,ni->nr", seen, unit(site - here))))
    np.testing.assert_allclose(angle, 0.5 * Camera().field_deg, atol=1e-6)
    on = outlines / np.array(scenario.body.radii_m)
    np.testing.assert_allclose(np.linalg.norm(on, axis=-1), 1.0, atol=1e-9)
    for outline in outlines:
        centre = outline.mean(axis=0)
        assert np.linalg.norm(site - centre) < 0.5 * np.linalg.norm(outline - centre, axis=1).min()


def test_the_ball_about_a_companion_moves_with_it(solution):
    mission = mission_of().changed({"body.companion": COMPANION})
    shown = Shown("two bodies", replace(solution, scenario=mission.scenario))
    frame = Frame(np.eye(3), np.zeros(3), np.zeros(3), 1.0)
    (ball,) = (t for t in keep_sets(frame, shown) if t["meta"].get("moves") == "companion")
    sizes = np.linalg.norm([ball[axis] for axis in "xyz"], axis=0)
    np.testing.assert_allclose(sizes, companion_distance_m(mission.scenario), atol=0.1)
    path = companion_of(frame, shown)
    times = np.linspace(*shown.nodes_s[[0, -1]], 1000)
    drawn = [np.interp(times, path["t_s"], x) for x in path["position"]]
    expected = mission.scene.companion.position(times).T
    assert np.linalg.norm(drawn - expected, axis=0).max() < 1.0


def test_drifts_begin_at_burns_and_mark_nearest(solution):
    shown = Shown("default", solution)
    edge = np.full(3, 1e5)
    paths = drifts(Frame(np.eye(3), -edge, edge, 1.0), shown)
    planned = [burn for number, burn in solution.executed if number > 1]
    for burn, path, mark in zip(planned, paths[::2], paths[1::2], strict=True):
        drawn = np.array([path[axis] for axis in "xyz"])
        begin = shown.positions(np.array([burn.t_s]))[0]
        np.testing.assert_allclose(drawn[:, 0], begin, atol=0.1)
        nearest = np.linalg.norm(drawn, axis=0).min()
        marked = np.linalg.norm([mark[axis][0] for axis in "xyz"])
        assert marked == pytest.approx(nearest, abs=0.2)
        assert f"{marked:.0f} m" in mark["name"]


def test_sun_is_on_the_horizon_at_the_terminator(shown):
    mission = shown.mission
    for time in (0.0, 15_000.0):
        longitude, latitude = terminator(shown, time)
        normal = np.array([direction_of(*place) for place in zip(latitude, longitude, strict=True)])
        sun = mission.rotation.body_to_j2000(time).T @ mission.sun_direction(time)
        np.testing.assert_allclose(normal @ sun, 0.0, atol=1e-12)


@given(generators)
def test_a_tube_is_made_of_its_covariance(rng):
    """Each point's deviation is in the plane across the path, and as many sigmas from it there."""
    path = np.cumsum(rng.uniform(0.5, 1.0, (12, 3)), axis=0) * 100.0
    factor = rng.normal(size=(12, 3, 3)) * 10.0
    covariance = factor @ np.swapaxes(factor, 1, 2)
    rings = tube(path, covariance, 3.0).vertices_m.reshape(12, RING, 3) - path[:, None]
    along = unit(np.gradient(path, axis=0))
    assert np.abs(np.einsum("nri,ni->nr", rings, along)).max() < 1e-6
    for ring, sigma, direction in zip(rings, covariance, along, strict=True):
        _, _, axes = np.linalg.svd(direction[None])
        plane = axes[1:]
        across = plane @ sigma @ plane.T
        flat = ring @ plane.T
        size = np.sqrt(np.einsum("ri,ij,rj->r", flat, np.linalg.inv(across), flat))
        np.testing.assert_allclose(size, 3.0, rtol=1e-6)


@given(generators)
def test_a_shell_keeps_to_its_distances_and_angles(rng):
    axis, apex = random_unit(rng), 100.0 * rng.normal(size=3)
    points = shell(axis, apex, (500.0, 740.0), (0.3, 0.8)).vertices_m - apex
    distance = np.linalg.norm(points, axis=1)
    angle = np.arccos(points @ axis / distance)
    assert ((distance > 499.999) & (distance < 740.001)).all()
    assert ((angle > 0.3 - 1e-6) & (angle < 0.8 + 1e-6)).all()


def test_large_mesh_is_simplified_and_stays_closed():
    fine = ellipsoid(np.array([280.0, 270.0, 250.0]), "")
    vertices, facets = fine.vertices_m, fine.facets
    for _ in range(2):  # every facet in three, about its middle
        middle = vertices[facets].mean(axis=1)
        number = len(vertices) + np.arange(len(facets))
        a, b, c = facets.T
        parts = [
            np.column_stack(corners) for corners in ((a, b, number), (b, c, number), (c, a, number))
        ]
        vertices, facets = np.vstack([vertices, middle]), np.vstack(parts)
    assert len(facets) > FACETS_MAX
    shape = _of_mesh(Mesh(vertices, facets[:, ::-1]))
    assert 1000 < len(shape.facets) <= FACETS_MAX
    assert f"{len(facets)} facets, drawn with" in shape.description
    a, b, c = np.moveaxis(shape.vertices_m[shape.facets], 1, 0)
    volume = np.einsum("ni,ni->", a, np.cross(b, c)) / 6.0
    assert volume == pytest.approx(4.0 / 3.0 * np.pi * 280.0 * 270.0 * 250.0, rel=0.05)
    ray = random_unit(np.random.default_rng(0), 50)
    np.testing.assert_allclose(shape.radius(ray), fine.radius(ray), rtol=0.01)


def test_missing_shape_file_is_named(solution, tmp_path):
    rock = Ellipsoid(np.array([100.0, 100.0, 90.0])).tessellated(0)
    file = write_obj(tmp_path / "rock.obj", rock)
    given = {"shape_file": str(file), "shape_unit": "m"}
    body = solution.scenario.body.model_copy(update=given)
    scenario = solution.scenario.model_copy(update={"body": body})
    assert shape_of(scenario).description == "shape file of 8 facets"
    file.unlink()
    assert "cannot be read" in shape_of(scenario).description
    bare = body.model_copy(update={"shape_file": None, "radii_m": None})
    assert "through the site" in shape_of(scenario.model_copy(update={"body": bare})).description


@pytest.mark.slow
def test_probabilities_are_the_verification_s(shown, verified):
    """The same draws: at the nodes the same numbers."""
    checked = verified.verification
    found = {one.name: one for one in shown.achieved}
    for p in checked.probabilities:
        one = found[p.name]
        at = np.flatnonzero(np.isclose(one.times_s, p.worst_t_s, atol=1e-6))
        if len(at):
            assert one.value[at[0]] == p.estimate
            assert (one.low[at[0]], one.high[at[0]]) == (p.low, p.high)
    so_far = found[SO_FAR].value
    assert (np.diff(so_far) <= 0.0).all()
    assert so_far[-1] <= min(one.value.min() for one in found.values())


@pytest.mark.slow
def test_the_budget_is_that_of_the_executed_burns(shown):
    budget = shown.budget
    total = shown.solution.total_dv_m_s
    assert budget.planned_m_s.sum() == pytest.approx(total, rel=1e-12)
    low, high = budget.interval_m_s
    assert total < low <= budget.total_high_m_s <= high < 1.2 * total
    below = (shown.flown.executed_m_s.sum(axis=1) < budget.total_high_m_s).mean()
    assert below == pytest.approx(0.99, abs=1e-3)
    assert budget.total_high_m_s < budget.high_m_s.sum()


@given(generators, st.integers(2, 20_000))
def test_thinning_loses_no_peak(rng, n):
    times, values = np.arange(n, dtype=float), rng.normal(size=n)
    t, v = thinned(times, values)
    assert len(t) <= max(2 * BINS, 2)
    assert (np.diff(t) > 0.0).all()
    assert (v.max(), v.min()) == (values.max(), values.min())
    np.testing.assert_array_equal(v, values[t.astype(int)])
