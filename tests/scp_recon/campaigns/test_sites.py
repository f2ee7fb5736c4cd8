"""Sites spread over a shape: evenly, from the first ones on, and seen at noon."""

import numpy as np
import pytest
from scipy.spatial import ConvexHull, KDTree

from scp_recon.bodies.surface import Ellipsoid, Mesh, direction_of
from scp_recon.campaigns.axes import (
    Axis,
    changed,
    even_sites,
    fibonacci,
    noons_of,
    parts,
    surface_of,
)
from scp_recon.campaigns.study import Study
from scp_recon.errors import InputError
from scp_recon.mission.scene import Scene
from scp_recon.scenario.load import load_scenario

SPHERE = Ellipsoid(np.full(3, 100.0))
BENNU = Ellipsoid(np.array([283.065, 271.215, 249.72]))
LONG = Ellipsoid(np.array([17.0, 5.5, 5.5]))


def meshed(surface: Ellipsoid, count: int = 600) -> Mesh:
    """Its hull over some points, facets turned outward."""
    points = fibonacci(count) * surface.radii_m
    facets = ConvexHull(points).simplices.astype(np.intp)
    a, b, c = np.moveaxis(points[facets], 1, 0)
    inward = np.einsum("ni,ni->n", a, np.cross(b - a, c - a)) < 0.0
    facets[inward] = facets[inward][:, ::-1]
    return Mesh(points, facets)


def shares(surface: Ellipsoid, sites: list[tuple[float, float]]) -> np.ndarray:
    """Area nearest to each site over the mean, by random directions that are weighted by it."""
    directions = np.random.default_rng(1).normal(size=(40_000, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    points = directions / np.linalg.norm(directions / surface.radii_m, axis=1, keepdims=True)
    gradient = points / surface.radii_m**2
    cosine = np.sum(directions * gradient, axis=1) / np.linalg.norm(gradient, axis=1)
    areas = np.sum(points**2, axis=1) / cosine
    places = np.array([surface.at(direction_of(*site))[0] for site in sites])
    found = np.bincount(KDTree(places).query(points)[1], areas, len(sites))
    return found / found.mean()


@pytest.mark.parametrize("surface", [SPHERE, BENNU])
def test_each_site_has_its_share_of_the_area(surface):
    found = shares(surface, even_sites(surface, 60))
    assert found.std() < 0.12
    assert 0.7 < found.min() < found.max() < 1.4


@pytest.mark.parametrize("surface", [BENNU, LONG])
def test_mesh_of_an_ellipsoid_has_its_sites(surface):
    found = shares(surface, even_sites(meshed(surface), 60)).std()
    assert found == pytest.approx(shares(surface, even_sites(surface, 60)).std(), abs=0.1)


@pytest.mark.parametrize("surface", [SPHERE, meshed(SPHERE)])
def test_the_parts_make_up_the_surface(surface):
    middles, areas = parts(surface, 3000)
    assert len(areas) >= 3000
    assert areas.sum() == pytest.approx(4.0 * np.pi * 100.0**2, rel=0.02)
    assert np.linalg.norm(areas @ middles / areas.sum()) < 0.5


@pytest.mark.parametrize("longitude", [0.0, 41.8, -120.0, 179.9])
def test_sun_is_at_noon_at_each_site(longitude):
    scenario = load_scenario("recon_b")
    moment = noons_of(scenario)(longitude)
    rotation = Scene.of(scenario).rotation
    assert 0.0 <= moment < 1.001 * 2.0 * np.pi / rotation.rate
    x, y, _ = rotation.body_to_j2000(moment).T @ -np.array(scenario.sun.body_position_km)
    apart = np.rad2deg(np.arctan2(y, x)) - longitude
    # The body moves by a hundredth of a degree about the Sun meanwhile.
    assert abs((apart + 180.0) % 360.0 - 180.0) < 0.3


def test_a_study_spreads_sites_and_moves_their_epochs():
    axis = {"spread": {"count": 12, "noon_at_s": 14_838.0}}
    study = Study.validated({"campaign": {"base": "kingfisher", "do": "design"}, "axis": [axis]})
    assert study.entries == (*("site.name", "site.latitude_deg", "site.longitude_deg"), "epoch.tdb")
    for case in (study.cases[0], study.cases[7]):
        scenario = changed(study.base, case.changes, study.folder)
        assert scenario.site.name == case.changes["site.name"]
        noon_s = noons_of(scenario)(case.changes["site.longitude_deg"])
        assert noon_s == pytest.approx(14_838, abs=2)


def test_sites_without_shape_or_radii_are_refused():
    base = load_scenario("recon_b")
    body = base.body.model_copy(update={"radii_m": None})
    with pytest.raises(InputError, match=r"body\.radii_m"):
        surface_of(base.model_copy(update={"body": body}))


def test_the_first_sites_are_spread_too():
    base = load_scenario("recon_b")
    rows = Axis.model_validate({"spread": {"count": 128}}).rows(base, (0,))
    places = [direction_of(row["site.latitude_deg"], row["site.longitude_deg"]) for row in rows]
    far = KDTree(places[:32]).query(fibonacci(2000))[0].max()
    alone = KDTree(fibonacci(32)).query(fibonacci(2000))[0].max()
    assert far < 1.8 * alone
    assert len({row["site.name"] for row in rows}) == 128


def test_sites_of_a_tumbling_body_keep_the_epoch():
    base = load_scenario("apophis")
    rows = Axis.model_validate({"spread": {"count": 4}}).rows(base, (0,))
    assert ["epoch.tdb" in row for row in rows] == [False] * 4
    noon = Axis.model_validate({"spread": {"count": 4, "noon_at_s": 0.0}})
    with pytest.raises(InputError, match="no noons"):
        noon.rows(base, (0,))
