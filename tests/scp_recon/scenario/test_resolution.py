"""From what is given to numbers: site, body, Sun and gravity, what is inherited and what is missing."""

import itertools
import math
from datetime import datetime
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st
from scipy.spatial import ConvexHull

from scp_recon.bodies.catalogue import J2000_TDB
from scp_recon.bodies.surface import Ellipsoid, Mesh, angle_deg, direction_of
from scp_recon.errors import InputError
from scp_recon.mission.scene import Scene, planned_field, solid_of, truth_field
from scp_recon.physics.forces import accelerations
from scp_recon.scenario.given import DERIVED
from scp_recon.scenario.load import load_scenario, override, validate_scenario
from scp_recon.scenario.schema import Scenario
from tests.scp_recon.bodies.test_kernels import BARE, GFC
from tests.scp_recon.bodies.test_surface import box, write_obj
from tests.scp_recon.support import mission_of, refusal

ROCK: dict[str, Any] = {
    "name": "Rock",
    "gm_m3_s2": 5.0,
    "j2": 0.04,
    "reference_radius_m": 290.0,
    "pole_ra_deg": 85.0,
    "pole_dec_deg": -60.0,
    "rotation_period_h": 4.3,
    "prime_meridian_at_epoch_deg": 317.6,
    "radii_m": [280.0, 270.0, 250.0],
}
PLACE = {"name": "Place", "latitude_deg": 56.0, "longitude_deg": 42.0}
STATE = {
    "body_position_km": [151091819.0, -4888099.83, -3401500.27],
    "body_velocity_km_s": [-4.30313922, 26.81106478, 15.16848766],
}


def rock(*overrides: str, **tables: dict[str, Any]) -> Scenario:
    """Reconnaissance B about another body."""
    data = {"base": "recon_b", "body": ROCK, "site": PLACE, "sun": STATE, **tables}
    return validate_scenario(data, overrides)


def refused(*overrides: str, **tables: dict[str, Any]) -> InputError:
    return refusal(rock, *overrides, **tables)


def w_deg(scenario: Scenario) -> float:
    """Prime meridian at the epoch."""
    return float(np.rad2deg(Scene.of(scenario).rotation.meridian))


# --- rotation -----------------------------------------------------------------------------------


@given(
    period=st.floats(0.05, 1e3) | st.floats(-1e3, -0.05),
    meridian=st.floats(-360.0, 360.0),
    epoch=st.datetimes(datetime(1990, 1, 1), datetime(2060, 1, 1)),
)
def test_period_and_meridian_at_epoch_give_the_rotation(period, meridian, epoch):
    body = ROCK | {"rotation_period_h": period, "prime_meridian_at_epoch_deg": meridian}
    found = rock(body=body, epoch={"tdb": epoch.isoformat()})
    assert found.body.prime_meridian_rate_deg_day * period / 24.0 == pytest.approx(360.0)
    apart = (w_deg(found) - meridian + 180.0) % 360.0 - 180.0
    days = abs((epoch - J2000_TDB).total_seconds()) / 86_400.0
    assert abs(apart) < 1e-12 * abs(8640.0 / period) * days + 1e-9


def test_a_packaged_body_needs_only_its_name(scenario):
    tables = {"base": "recon_b", "body": {"name": "Bennu"}}
    bare = scenario.model_dump(mode="json", exclude_none=True)
    del bare["sun"]
    bare["body"] = {"name": "bennu"}
    found = validate_scenario(bare)
    given_body, body = scenario.body.model_dump(), found.body.model_dump()
    assert body | {"name": "Bennu"} == given_body
    assert validate_scenario(tables) == scenario
    assert angle_deg(found.sun.body_position_km, scenario.sun.body_position_km) < 0.01


def test_given_entries_win_over_packaged_ones():
    heavier = load_scenario(None, ["body.gm_m3_s2=6.0"])
    assert (heavier.body.gm_m3_s2, heavier.body.pole_ra_deg) == (6.0, 85.46097)
    bare = {"base": "recon_b", "body": {"name": "Eros", "j2": 0.1}, "site": PLACE}
    error = refusal(validate_scenario, bare)
    assert error.entry == "body.reference_radius_m"


# --- site ---------------------------------------------------------------------------------------


@given(latitude=st.floats(-90.0, 90.0), longitude=st.floats(-180.0, 180.0))
def test_site_by_coordinates_equals_site_by_position(latitude, longitude):
    place = {"name": "Place", "latitude_deg": latitude, "longitude_deg": longitude}
    site = rock(site=place).site
    assert angle_deg(site.position_body_m, direction_of(latitude, longitude)) < 1e-9
    assert np.linalg.norm(site.normal_body) == pytest.approx(1.0)
    again = rock(site={"name": "Place", "position_body_m": list(site.position_body_m)}).site
    np.testing.assert_allclose(again.normal_body, site.normal_body, atol=1e-9)


def test_a_site_on_a_shape_file(tmp_path):
    write_obj(tmp_path / "box.obj", box(np.array([0.28, 0.27, 0.25])))
    text = (
        'base = "recon_b"\n[body]\nname = "Bennu"\nshape_file = "box.obj"\nshape_unit = "km"\n'
        "[site]\nlatitude_deg = 80.0\nlongitude_deg = 10.0\n"
    )
    (tmp_path / "mine.toml").write_text(text, "utf-8")
    found = load_scenario(tmp_path / "mine.toml")
    assert found.site.position_body_m[2] == pytest.approx(250.0)
    np.testing.assert_allclose(found.site.normal_body, [0.0, 0.0, 1.0], atol=1e-12)
    # Resolved once: nothing but a new site needs the file again.
    (tmp_path / "box.obj").unlink()
    assert found.replace({"risk.p_chance": 0.8}).site == found.site
    assert override(found, ["burns.dv_max_m_s=0.3"]).site == found.site
    assert Scenario.model_validate_json(found.model_dump_json()) == found
    error = refusal(found.replace, {"site.latitude_deg": 70.0})
    assert "shape" in error.entry


def test_a_solid_gives_j2_and_is_stored(tmp_path):
    mesh = Ellipsoid(np.array([300.0, 200.0, 150.0])).tessellated(2)
    file = write_obj(tmp_path / "solid.obj", mesh)
    bare = {key: ROCK[key] for key in ROCK if key not in ("j2", "reference_radius_m")}
    found = rock(body=bare | {"solid_file": str(file), "shape_unit": "m"})
    file.unlink()
    again = Scenario.model_validate_json(found.model_dump_json())
    np.testing.assert_allclose(solid_of(again.body).vertices_m, mesh.vertices_m, rtol=1e-9)
    planned = planned_field(again.replace({"body.planned_degree": 2}))
    assert planned is not None
    assert again.body.j2 == pytest.approx(planned.j2, rel=1e-6)
    assert 300.0 < again.body.reference_radius_m < 330.0  # of the same volume, so a little longer


def test_polyhedron_truth_flies_the_solid(tmp_path):
    """A ball's pull is that of a point, but for its facets; the verdict says what was flown."""
    mesh = Ellipsoid(np.full(3, 290.0)).tessellated(3)
    file = write_obj(tmp_path / "ball.obj", mesh)
    mission = mission_of(f'body.solid_file="{file}"', 'body.shape_unit="m"', "body.j2=0")
    assert mission.scene.gravity_in_words("polyhedron") == "a homogeneous polyhedron of 512 facets"
    at = np.array([[900.0], [500.0], [-700.0]])
    exact, point = (
        accelerations(at, forces, forces.moment(0.0))
        for forces in map(mission.scene.forces, ("polyhedron", "planner"))
    )
    np.testing.assert_allclose(exact, point, rtol=1e-4)


def test_a_solid_that_is_none_is_refused(tmp_path):
    mesh = Ellipsoid(np.full(3, 250.0)).tessellated(2)
    inward = write_obj(tmp_path / "inward.obj", Mesh(mesh.vertices_m, mesh.facets[:, ::-1]))
    error = refused(body=ROCK | {"solid_file": str(inward), "shape_unit": "m"})
    assert (error.entry, "turn inward" in str(error)) == ("body.solid_file", True)
    assert refused(body=ROCK | {"solid_file": str(inward)}).entry == "body.shape_unit"
    with pytest.raises(InputError, match="truth='polyhedron'") as caught:
        solid_of(rock().body.model_copy(update={"radii_m": None}))
    assert caught.value.entry == "body.solid_file"


NEARLY_ROUND, LONG = (283.0, 271.0, 250.0), (400.0, 280.0, 150.0)


@pytest.mark.parametrize(
    ("half", "order", "words"),
    [
        *((LONG, order, "unit and axes") for order in list(itertools.permutations(range(3)))[1:]),
        # Bennu's extents: each within a factor of 1.3 of every other.
        (NEARLY_ROUND, (0, 2, 1), "turn inward"),  # a swap mirrors
        (NEARLY_ROUND, (1, 0, 2), "turn inward"),
        (NEARLY_ROUND, (2, 0, 1), "90 deg off z"),  # a rotation does not
        (NEARLY_ROUND, (1, 2, 0), "90 deg off z"),
    ],
)
def test_shapes_with_wrong_axes_or_units_are_refused(half, order, words, tmp_path):
    mesh = box(np.array(half))
    body = ROCK | {"radii_m": list(half), "shape_unit": "m"}
    straight = {"shape_file": str(write_obj(tmp_path / "straight.obj", mesh))}
    assert rock(body=body | straight).site.position_body_m
    assert "unit and axes" in refused(body=body | straight | {"shape_unit": "km"}).allowed
    swapped = write_obj(tmp_path / "s.obj", Mesh(mesh.vertices_m[:, order], mesh.facets))
    error = refused(body=body | {"shape_file": str(swapped)})
    assert error.entry == "body.shape_file"
    assert words in str(error)
    aside = Mesh(mesh.vertices_m + np.array([0.0, 60.0, 0.0]), mesh.facets)
    moved = write_obj(tmp_path / "moved.obj", aside)
    assert "60 m off the origin" in refused(body=body | {"shape_file": str(moved)}).given


@pytest.mark.parametrize("radius_m", [0.03, 30_000.0])
def test_a_normal_radius_in_another_unit_is_refused(radius_m, tmp_path):
    """Thirty metres in kilometres, and in millimetres; of a closed surface the sum of all is noise."""
    points = np.array([direction_of(x, y) for x in range(-80, 90, 20) for y in range(0, 360, 20)])
    points *= NEARLY_ROUND
    hull = ConvexHull(points)
    outward = np.linalg.det(points[hull.simplices]) > 0.0
    facets = np.where(outward[:, None], hull.simplices, hull.simplices[:, ::-1])
    file = write_obj(tmp_path / "round.obj", Mesh(points, facets))
    body = ROCK | {"shape_unit": "m", "shape_file": str(file)}
    assert rock(body=body, site=PLACE | {"normal_radius_m": 30.0}).site.normal_radius_m == 30.0
    error = refused(body=body, site=PLACE | {"normal_radius_m": radius_m})
    assert error.entry == "site.normal_radius_m"
    assert "a tenth of" in error.allowed


@pytest.mark.parametrize(
    ("site", "entry"),
    [
        ({"position_body_m": [0.091, 0.082, 0.181]}, "site.position_body_m"),  # km
        ({"position_body_m": [91.0, 82.0, 181.0], **PLACE, "latitude_deg": 57.0}, "site.latitude_deg"),
        ({"position_body_m": [91.0, 82.0, 181.0], "normal_body": [0.0, -1.0, 0.0]}, "site.normal_body"),
        ({"latitude_deg": 56.0, "longitude_deg": 42.0, "normal_radius_m": 5.0}, "site.normal_radius_m"),
        ({"latitude_deg": 100.0, "longitude_deg": 42.0}, "site.latitude_deg"),
        ({"latitude_deg": 56.0}, "site"),
    ],
)  # fmt: skip
def test_a_site_that_contradicts_itself_is_refused(site, entry):
    assert refused(site={"name": "Place"} | site).entry.startswith(entry)


def test_short_vectors_and_coordinates_without_shape_are_refused():
    for entry in ("sun.body_position_km", "site.position_body_m", "body.radii_m"):
        assert refused(f"{entry}=[1.0, 2.0]").entry == entry
    body = {key: value for key, value in ROCK.items() if key != "radii_m"}
    assert "body.radii_m" in refused(body=body).allowed


# --- the Sun ------------------------------------------------------------------------------------


@given(epoch=st.datetimes(datetime(2012, 1, 2), datetime(2035, 12, 30)))
def test_another_epoch_has_its_own_sun(epoch):
    found = load_scenario(None, [f"epoch.tdb={epoch.isoformat()}"])
    again = found.replace({"epoch.tdb": "2020-01-21T20:33:17.184"})
    position = np.array(found.sun.body_position_km)
    assert 0.88 < np.linalg.norm(position) / 149_597_870.7 < 1.37  # perihelion and aphelion
    assert angle_deg(again.sun.body_position_km, STATE["body_position_km"]) < 0.01


@given(
    factor=st.just(1.0)
    | st.sampled_from([1e-3, 1e3])
    | st.floats(1.02, 1e3)
    | st.floats(1e-3, 0.98),
    off=st.floats(0.2, 179.0),
    turn=st.floats(0.0, 6.3),
)
def test_a_sun_contradicting_the_elements_is_refused(factor, off, turn):
    """In another direction, or at another distance: another unit."""
    sun = np.array(STATE["body_position_km"])
    along = sun / np.linalg.norm(sun)
    one = np.cross(along, [0.0, 0.0, 1.0]) / np.linalg.norm(np.cross(along, [0.0, 0.0, 1.0]))
    across = math.cos(turn) * one + math.sin(turn) * np.cross(along, one)
    angle = math.radians(off) if factor == 1.0 else 0.0
    moved = factor * np.linalg.norm(sun) * (math.cos(angle) * along + math.sin(angle) * across)
    with pytest.raises(InputError, match="Bennu") as caught:
        load_scenario(None, [f"sun.body_position_km={moved.tolist()}"])
    assert caught.value.entry == "sun.body_position_km"


@pytest.mark.parametrize("year", ["0001", "0999", "9001", "9999"])
def test_years_beyond_the_calendar_are_refused(year):
    error = refused(epoch={"tdb": f"{year}-12-31T23:59:59"})
    assert (error.entry, "1000 to 9000" in error.allowed) == ("epoch.tdb", True)


def test_epoch_utc_replaces_tdb():
    found = load_scenario(None, ["epoch.utc=2021-06-01T05:58:50.815Z"])
    assert abs((found.epoch.tdb - datetime(2021, 6, 1, 6)).total_seconds()) < 2e-3
    there = load_scenario(None, ["epoch.tdb=2021-06-01T06:00:00"]).sun.body_position_km
    np.testing.assert_allclose(found.sun.body_position_km, there, atol=0.1)
    later = found.replace({"epoch.utc": "2021-06-01T08:58:50.815+02:00"})
    assert (later.epoch.tdb - found.epoch.tdb).total_seconds() == pytest.approx(3600.0)
    assert found.replace({"epoch.tdb": "2021-06-02T06:00:00"}).epoch.tdb.day == 2


@pytest.mark.parametrize(
    ("epoch", "words"),
    [
        (["utc=2020-01-21T20:33:17", "tdb=2020-01-21T20:33:17"], "69.185 s apart"),
        (["utc=1960-01-01T00:00:00"], "1972 or later"),
        (["utc=9999-12-31T23:59:59"], "at most in 9998"),
        (["utc=9999-12-31T23:59:59-10:00"], "at most in 9998"),
        (["utc=0001-01-01T00:00:00+10:00"], "1972 or later"),
        (["utc=soon"], "must be"),
        (["tdb=2050-01-01T00:00:00"], "2012 to 2035"),
    ],
)
def test_wrong_or_unknown_epochs_are_refused(epoch, words):
    with pytest.raises(InputError, match=words):
        load_scenario(None, [f"epoch.{one}" for one in epoch])


def test_another_epoch_inherits_no_sun():
    error = refused("epoch.tdb=2021-01-01T00:00:00", "body.prime_meridian_at_epoch_deg=3.0")
    assert error.entry == "sun.body_position_km"
    assert "inherits no Sun" in error.allowed


def test_an_epoch_changed_alone_is_refused(scenario):
    dated = {"sun": STATE | {"state_tdb": scenario.epoch.tdb.isoformat()}}
    assert rock(**dated).sun.body_position_km == rock().sun.body_position_km
    error = refused(epoch={"tdb": "2020-07-21T00:00:00"}, **dated)
    assert error.entry == "epoch.tdb"
    assert "sun.state_tdb" in error.allowed


# --- gravity ------------------------------------------------------------------------------------


def test_gravity_file_gives_planner_j2_and_truth_field(tmp_path):
    (tmp_path / "field.gfc").write_text(GFC, "utf-8")
    light = {k: v for k, v in ROCK.items() if k not in ("gm_m3_s2", "j2", "reference_radius_m")}
    found = rock(body=light | {"gravity_file": str(tmp_path / "field.gfc")})
    assert found.body.gm_m3_s2 == pytest.approx(4.89)
    assert found.body.j2 == pytest.approx(math.sqrt(5.0) * 0.0192)
    field = truth_field(found)
    assert (field.gm, field.radius, len(field.c)) == (found.body.gm_m3_s2, 290.0, 4)
    c_bar, s_bar = field.normalised()
    assert (c_bar[2, 2], s_bar[3, 1]) == (pytest.approx(0.003), pytest.approx(-5e-4))
    # It is in the scenario: the truth flies it where the file is not.
    (tmp_path / "field.gfc").unlink()
    again = Scenario.model_validate_json(found.model_dump_json())
    np.testing.assert_array_equal(truth_field(again.replace({"risk.p_chance": 0.8})).c, field.c)


def test_given_j2_must_agree_with_the_gravity_file(tmp_path):
    """A table without a radius takes the body's."""
    (tmp_path / "field.gfc").write_text(GFC, "utf-8")
    j2 = math.sqrt(5.0) * 0.0192
    body = ROCK | {"gm_m3_s2": 4.89, "gravity_file": str(tmp_path / "field.gfc")}
    assert rock(body=body | {"j2": j2}).body.j2 == j2
    for wrong in ({"j2": 0.05}, {"j2": j2, "gm_m3_s2": 4.89e-9}):
        assert refused(body=body | wrong).entry == f"body.{[*wrong][-1]}"
    del body["j2"]
    nearer = rock(body=body | {"reference_radius_m": 145.0})
    assert nearer.body.j2 == pytest.approx(4.0 * j2)
    (tmp_path / "field.tab").write_text(BARE, "utf-8")
    bare = rock(body=ROCK | {"j2": j2, "gravity_file": str(tmp_path / "field.tab")}).body
    assert bare.gravity.reference_radius_m == ROCK["reference_radius_m"]


def test_stored_field_must_agree_with_j2():
    """As a solution file has it, whose gravity file is gone."""
    rows = [[2, 0, -0.0192, 0.0], [2, 2, 0.003, 0.001]]
    body = ROCK | {"gravity": {"reference_radius_m": 145.0, "coefficients": rows}}
    j2 = math.sqrt(5.0) * 0.0192 / 4.0
    found = rock(body=body | {"j2": j2})
    assert found.replace({"risk.p_chance": 0.8}).body == found.body
    with pytest.raises(InputError, match=r"body\.j2: got 0\.04; .* 0\.0107"):
        found.replace({"body.j2": 0.04})


def test_the_documented_example_loads(tmp_path):
    page = (Path(__file__).parents[3] / "docs" / "scenario.md").read_text("utf-8")
    (tmp_path / "mine.toml").write_text(page.split("```toml\n")[1].split("```")[0], "utf-8")
    found = load_scenario(tmp_path / "mine.toml")
    assert (found.name, found.site.latitude_deg) == ("next_year", 50.0)


def chain(folder: Path, *texts: str) -> Path:
    """Files that are each the base of the next; the last one."""
    for number, text in enumerate(texts):
        base = "recon_b" if number == 0 else f"{number - 1}.toml"
        (folder / f"{number}.toml").write_text(f'base = "{base}"\n{text}', "utf-8")
    return folder / f"{len(texts) - 1}.toml"


def test_a_base_may_be_ones_own_file(tmp_path, monkeypatch):
    (tmp_path / "a").mkdir()
    chain(tmp_path / "a", "[risk]\np_chance = 0.8\n", "[grid]\nstep_max_s = 100.0\n")
    (tmp_path / "top.toml").write_text('base = "a/1.toml"\nname = "top"\n', "utf-8")
    monkeypatch.chdir("/")
    found = load_scenario(tmp_path / "top.toml")
    assert (found.name, found.risk.p_chance, found.grid.step_max_s) == ("top", 0.8, 100.0)


@pytest.mark.parametrize(
    "base", ['"1.toml"', '"./0.toml"', '"no.toml"', '"/"', '""', "5", "[1]", '"a\\nb"']
)
def test_a_base_that_is_none_is_refused(base, tmp_path):
    last = chain(tmp_path, "", "")
    (tmp_path / "0.toml").write_text(f"base = {base}\n", "utf-8")
    error = refusal(load_scenario, last)
    assert error.entry == "base"


def test_a_base_without_entries_is_named(tmp_path):
    (tmp_path / "empty.toml").write_text("other = 1\n", "utf-8")
    (tmp_path / "mine.toml").write_text('base = "empty.toml"\n', "utf-8")
    error = refusal(load_scenario, tmp_path / "mine.toml")
    assert (error.entry, error.file) == ("scenario", str(tmp_path / "empty.toml"))


def test_bases_come_to_an_end(tmp_path):
    assert load_scenario(chain(tmp_path, *[""] * 8))
    with pytest.raises(InputError, match="8 files at most"):
        load_scenario(chain(tmp_path, *[""] * 12))


@given(latitude=st.floats(-80.0, 80.0), other=st.floats(-80.0, 80.0))
def test_inherited_site_follows_its_coordinates(latitude, other):
    assume(abs(latitude - other) > 1e-3)
    first = rock(site=PLACE | {"latitude_deg": latitude})
    second = first.replace({"site.latitude_deg": other})
    assert second == rock(site=PLACE | {"latitude_deg": other})
    # A position without a normal has the surface's, and not the base's.
    third = first.replace({"site.position_body_m": list(second.site.position_body_m)})
    np.testing.assert_allclose(third.site.normal_body, second.site.normal_body, atol=1e-9)
    assert third.site.latitude_deg is None


def test_another_body_inherits_nothing_of_the_first():
    error = refusal(load_scenario, None, ["body.name=Rock"])
    told = str(error)
    for entry in ("body.gm_m3_s2", "body.pole_ra_deg", "sun.body_position_km", "site.normal_body"):
        assert entry in told
    assert "risk.p_chance" not in told


def test_all_missing_entries_are_told_at_once():
    error = refusal(validate_scenario, {"name": "empty", "risk": {}})
    told = str(error).splitlines()[0]
    for table, field in Scenario.model_fields.items():
        for key, entry in getattr(field.annotation, "model_fields", {}).items():
            assert (f"{table}.{key}" in told) == entry.is_required(), f"{table}.{key}"


@pytest.mark.parametrize(
    "wrong", ["epoch.tdb=2021-03-14T06:00:00Z", "body.pole_dec_deg=100.0", "site.latitude_deg=95.0"]
)
def test_derivable_entries_are_not_called_missing(wrong):
    """It is computed once that is right."""
    error = refusal(load_scenario, None, [wrong, "site.longitude_deg=10.0"])
    assert error.entry == wrong.partition("=")[0]
    assert "missing" not in str(error)


def test_missing_entries_are_listed_beside_a_wrong_one():
    tables = load_scenario().model_dump(mode="json", exclude_none=True)
    tables["epoch"]["tdb"] = "tomorrow"
    del tables["sun"], tables["risk"]["p_chance"]
    with pytest.raises(InputError, match=r"missing: risk\.p_chance"):
        validate_scenario(tables)


def test_derived_entries_exist_in_the_schema():
    for table, names in DERIVED.items():
        model = Scenario.model_fields[table].annotation
        assert {name.partition(".")[2] for name in names} <= model.model_fields.keys()
