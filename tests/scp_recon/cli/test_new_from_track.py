"""`python -m scp_recon new --from-spice`, `--from-oem`, `--from-csv`: kernels that the tests write."""

from dataclasses import replace
from datetime import datetime
from functools import partial
from pathlib import Path

import numpy as np
import pytest

from scp_recon.bodies.catalogue import J2000_TDB
from scp_recon.cli.commands import new
from scp_recon.interop.ccsds import oem_text
from scp_recon.interop.export import Export
from scp_recon.interop.files import csv_text
from scp_recon.interop.tracks import csv_track
from scp_recon.scenario.load import load_scenario
from scp_recon.scenario.time_scales import tdb_of_utc
from tests import reference
from tests.scp_recon.support import status_of

pytestmark = pytest.mark.slow

CRAFT, STONE, SUN = -64, 20099942, 10
FROM, TO = "2020-01-21T20:32:08", "2020-01-22T06:12:49"
SITE = ("--site", "55.9,41.8")
SPAN = ("--from", FROM, "--to", TO)
SUN_STATE = np.array([1.5e8, -5e6, -3.4e6, -4.3, 26.8, 15.2])
"""Of Stone about the Sun at --from, km and km/s."""


@pytest.fixture(autouse=True)
def _elsewhere(monkeypatch, tmp_path) -> None:
    monkeypatch.chdir(tmp_path)


@pytest.fixture(scope="module")
def export(solution) -> Export:
    return Export.of(solution, CRAFT)


@pytest.fixture(scope="module")
def meta(export, tmp_path_factory) -> Path:
    return kernels_of(export, tmp_path_factory.mktemp("kernels"))


def kernels_of(export: Export, folder: Path, unit_m: float = 1e3) -> Path:
    """A meta-kernel of Bennu and of Stone, with the plan as what CRAFT flew about both."""
    spice = pytest.importorskip("spiceypy")
    stone = (
        f"BODY{STONE}_RADII = ( 0.29 0.27 0.25 )",
        f"BODY{STONE}_GM = {reference.GM_M3_S2 * 1e-9!r}",
        f"NAIF_BODY_NAME += 'STONE'\nNAIF_BODY_CODE += {STONE}",
    )
    texts = (
        reference.write_bennu_kernel(folder),
        reference.write_bennu_kernel(folder, STONE, stone),
    )
    et, begin = [export.et(coast.times_s) for coast in export.coasts], et_of(FROM)
    handle = spice.spkopn(str(folder / "all.bsp"), "test", 0)
    for body in (reference.BENNU, STONE):
        for times, coast in zip(et, export.coasts, strict=True):
            states = np.ascontiguousarray(coast.states / unit_m)
            spice.spkw13(
                handle, CRAFT, body, "J2000", times[0], times[-1], "flight", 3, len(times), states,
                times,
            )  # fmt: skip
        span = np.array([begin - 1e5, begin + 1e5])
        line = SUN_STATE[:3] + np.outer(span - begin, SUN_STATE[3:])
        about = np.hstack([line, np.tile(SUN_STATE[3:], (2, 1))])
        spice.spkw13(handle, body, SUN, "J2000", *span, "way", 3, 2, about, span)
    spice.spkcls(handle)
    listed, files = folder / "all.tm", [*(path.name for path in texts), "all.bsp"]
    listed.write_text(
        f"KPL/MK\n\\begindata\nPATH_VALUES = ( '{folder}' )\nPATH_SYMBOLS = ( 'K' )\n"
        "KERNELS_TO_LOAD = ( " + ", ".join(f"'$K/{name}'" for name in files) + " )\n"
    )
    return listed


run = partial(status_of, new.main)


def et_of(utc: str) -> float:
    return (tdb_of_utc(datetime.fromisoformat(utc)) - J2000_TDB).total_seconds()


def state_of(meta: Path, body: int, utc: str) -> np.ndarray:
    import spiceypy

    with spiceypy.KernelPool(str(meta)):
        return np.array(spiceypy.spkgeo(CRAFT, et_of(utc), "J2000", body)[0]) * 1e3


@pytest.mark.parametrize(("name", "number"), [("Bennu", reference.BENNU), ("Stone", STONE)])
def test_body_sun_boundary_and_start_are_the_kernels(meta, name, number, capsys):
    words = ("--from-spice", str(meta), f"--spacecraft={CRAFT}", "--body", name)
    assert run("mine", *words, *SITE, *SPAN) == 0
    assert "\nverified" in capsys.readouterr().out
    scenario = load_scenario("mine.toml")
    body, boundary = scenario.body, scenario.boundary
    assert scenario.epoch.tdb == tdb_of_utc(datetime.fromisoformat(FROM))
    assert (body.name, body.naif_id) == (name, number)
    assert body.gm_m3_s2 == pytest.approx(reference.GM_M3_S2)
    assert (body.pole_ra_deg, body.pole_dec_deg) == (reference.POLE_RA_DEG, reference.POLE_DEC_DEG)
    assert body.prime_meridian_deg == reference.PRIME_MERIDIAN[0]
    assert body.prime_meridian_rate_deg_day == reference.PRIME_MERIDIAN[1]
    assert boundary.frame == "j2000"
    for which, utc in (("initial", FROM), ("final", TO)):
        expected = state_of(meta, number, utc)
        given = [getattr(boundary, f"{which}_{name}") for name in ("position_m", "velocity_m_s")]
        np.testing.assert_allclose(np.ravel(given), expected, rtol=1e-9)
    sun = (*scenario.sun.body_position_km, *scenario.sun.body_velocity_km_s)
    np.testing.assert_allclose(sun, SUN_STATE, rtol=1e-9)
    duration = datetime.fromisoformat(TO) - datetime.fromisoformat(FROM)
    assert scenario.duration_s == pytest.approx(duration.total_seconds(), abs=1e-4)
    start = csv_track(Path("mine_start.csv"), scenario.epoch.tdb)
    assert start.duration_s == pytest.approx(scenario.duration_s)
    np.testing.assert_allclose(start.states[0], state_of(meta, number, FROM), rtol=1e-12)


@pytest.mark.parametrize("form", ["oem", "csv"])
def test_a_message_or_a_table_is_a_start(export, form, capsys):
    if form == "oem":
        pytest.importorskip("oem")
    path = Path(f"plan.{form}")
    path.write_text(oem_text(export) if form == "oem" else csv_text(export), encoding="utf-8")
    epoch = export.mission.scenario.epoch.tdb.isoformat()
    words = () if form == "oem" else ("--epoch", epoch)
    # UTC of the first and last burn, to the microsecond
    ends = ("--from", "2020-01-21T20:32:07.999497", "--to", "2020-01-22T06:12:49.999486")
    assert run("mine", f"--from-{form}", str(path), "--body", "Bennu", *SITE, *words, *ends) == 0
    assert "\nverified" in capsys.readouterr().out
    scenario = load_scenario("mine.toml")
    given = (*scenario.boundary.initial_position_m, *scenario.boundary.initial_velocity_m_s)
    np.testing.assert_allclose(given, export.mission.initial_state, rtol=1e-6)
    assert scenario.duration_s == pytest.approx(export.mission.scenario.duration_s, abs=1e-5)


@pytest.mark.parametrize(
    ("form", "position", "speed", "asked"),
    [
        ("oem", 1e3, 1e3, "must be in km and km/s, not m and m/s?"),
        ("oem", 1.0, 1e3, "must be in km and km/s, not km and m/s?"),
        ("csv", 1e-3, 1e-3, "must be in m and m/s, not km and km/s?"),
        ("csv", 1.0, 1e3, "must be in m and m/s, not m and mm/s?"),
    ],
)
def test_states_in_other_units_are_named_by_line(export, form, position, speed, asked, capsys):
    factors = np.repeat([position, speed], 3)
    coasts = [replace(one, states=factors * one.states) for one in export.coasts]
    scaled = replace(export, coasts=coasts)
    text = oem_text(scaled) if form == "oem" else csv_text(scaled)
    Path(f"plan.{form}").write_text(text, encoding="utf-8")
    lines = text.splitlines()
    row = next(n for n, line in enumerate(lines) if line.startswith(("2020", "t_s")))
    first = row + 1 + (form == "csv")
    epoch = ("--epoch", export.mission.scenario.epoch.tdb.isoformat())
    words = ("--body", "Bennu", *SITE, *(() if form == "oem" else epoch))
    assert run("mine", f"--from-{form}", f"plan.{form}", *words) == 2
    said = capsys.readouterr().err
    assert f"error: --from-{form} plan.{form}, line {first}: got " in said
    assert asked in said


def test_kernel_in_metres_is_named_with_its_unit(export, tmp_path, capsys):
    meta = kernels_of(export, tmp_path, unit_m=1.0)
    assert (
        run("mine", "--from-spice", str(meta), "--spacecraft=-64", "--body", "Bennu", *SITE, *SPAN)
        == 2
    )
    said = capsys.readouterr().err
    assert f"error: --from-spice {meta}, at --from: got 11" in said
    assert "must be in km" in said


SPICE = ("--from-spice", "META", "--spacecraft=-64")


@pytest.mark.parametrize(
    ("words", "expected"),
    [
        (SPICE[:2], "--spacecraft"),
        ((*SPICE, "--from", FROM), "--to"),
        ((*SPICE, "--from", TO, "--to", FROM), "--to"),
        ((*SPICE, "--from", FROM, "--to", "2020-01-22T02:00:00"), "begin earlier or end later"),
        # Of a packaged body the kernel has to have the same Sun within 0.1 deg: here a week off.
        ((*SPICE, "--from", "2020-01-29T20:32:08", "--to", "2020-01-30T06:12:49"), "--from-spice"),
        ((*SPICE[:2], "--spacecraft=-65", *SPAN), "-65"),
        (("--from-spice", "nothing.tm", "--spacecraft=-64", *SPAN), "--from-spice"),
        ((*SPICE, *SPAN, "--epoch", FROM), "--epoch"),
        ((*SPICE[:2], "--from-csv", "x.csv", "--epoch", FROM), "more than one"),
        ((*SPICE, *SPAN, "--body", "Pebble"), "--body"),
        ((*SPICE[:2], "--spacecraft=x"), "--spacecraft"),
        ((*SPICE, *SPAN, "--gm", "3"), "--gm: got 3.0"),
    ],
)
def test_bad_input_ends_in_one_message(meta, words, expected, capsys):
    given = [str(meta) if word == "META" else word for word in words]
    assert run("mine", "--body", "Bennu", *SITE, *given) == 2
    said = capsys.readouterr()
    assert expected in said.err
    assert "Traceback" not in said.err
    assert not list(Path().glob("mine*"))
