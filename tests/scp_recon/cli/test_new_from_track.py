"""`python -m scp_recon new --from-spice`, `--from-oem`, `--from-csv`: kernels that the tests write."""

from dataclasses import replace
from datetime import datetime, timedelta
from functools import partial
from pathlib import Path

import numpy as np
import pytest

from scp_recon.bodies.catalogue import J2000_TDB
from scp_recon.cli.commands import new
from scp_recon.drafting.flown import Track
from scp_recon.errors import InputError
from scp_recon.interop.ccsds import oem_text
from scp_recon.interop.export import Export, Ids
from scp_recon.interop.files import csv_text
from scp_recon.interop.path import fly_path
from scp_recon.interop.tracks import csv_track, cut, oem_track, pull_doubts, step_doubts
from scp_recon.scenario.load import load_scenario
from scp_recon.scenario.time_scales import tdb_of_utc
from tests import reference
from tests.scp_recon.support import status_of

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
def export(mission, solution) -> Export:
    return Export(solution, mission, fly_path(mission, solution), Ids(CRAFT, reference.BENNU))


@pytest.fixture(scope="module")
def meta(export, tmp_path_factory) -> Path:
    """A meta-kernel of Bennu and of Stone, with the plan as what CRAFT flew about both."""
    spice = pytest.importorskip("spiceypy")
    folder = tmp_path_factory.mktemp("kernels")
    stone = (
        f"BODY{STONE}_RADII = ( 0.29 0.27 0.25 )",
        f"BODY{STONE}_GM = {reference.GM_M3_S2 * 1e-9!r}",
        f"NAIF_BODY_NAME += 'STONE'\nNAIF_BODY_CODE += {STONE}",
    )
    texts = (
        reference.write_bennu_kernel(folder),
        reference.write_bennu_kernel(folder, STONE, stone),
    )
    et, begin = [export.et(coast.times_s) for coast in export.path.coasts], et_of(FROM)
    handle = spice.spkopn(str(folder / "all.bsp"), "test", 0)
    for body in (reference.BENNU, STONE):
        for times, coast in zip(et, export.path.coasts, strict=True):
            states = np.ascontiguousarray(coast.states / 1e3)
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
    ("key", "given", "message"),
    [
        ("REF_FRAME", "TEME", "EME2000.*; turn the states"),
        ("REF_FRAME", "EME2000\nREF_FRAME_EPOCH = 2020-01-01T12:00:00", "EPOCH: got 2020.*left"),
        ("REF_FRAME", "ICRF\nREF_FRAME_EPOCH = 2000-01-01", "REF_FRAME_EPOCH: got time data"),
        ("CCSDS_OEM_VERS", "1.0\nREF_FRAME_EPOCH = 2000-01-01", "no OEM.*CCSDS_OEM_VERS"),
        ("CENTER_NAME", "EARTH", "BENNU"),
        ("TIME_SYSTEM", "MRT", "TIME_SYSTEM"),
        ("TIME_SYSTEM", "UT1", "UTC or TDB"),
    ],
)
def test_another_frame_centre_or_scale_is_refused(export, key, given, message):
    pytest.importorskip("oem")
    lines = oem_text(export).splitlines()
    text = "\n".join(f"{key} = {given}" if line.startswith(f"{key} =") else line for line in lines)
    Path("plan.oem").write_text(text, encoding="ascii")
    with pytest.raises(InputError, match=message):
        oem_track(Path("plan.oem"), "Bennu")


HERA = """CCSDS_OEM_VERS = 2.0
CREATION_DATE  = 2023-08-23T00:00:00
ORIGINATOR     = ESA/ESOC OPS-GFA

META_START
OBJECT_NAME    = Hera
OBJECT_ID      = -91
CENTER_NAME    = DidymosBarycenter
REF_FRAME      = EME2000
REF_FRAME_EPOCH = 2000-01-01T12:00:00.000
TIME_SYSTEM    = TDB
START_TIME     = 2027-02-01T00:00:00.000000
STOP_TIME      = 2027-02-01T02:00:00.000000
META_STOP

2027-02-01T00:00:00.000000  10.0  -2.0  1.5 -1.0e-4  2.0e-5  0.0
2027-02-01T01:00:00.000000  9.64  -1.928  1.5 -1.0e-4  2.0e-5  0.0
2027-02-01T02:00:00.000000  9.28  -1.856  1.5 -1.0e-4  2.0e-5  0.0
"""
"""A file of our own with originator and names as in ESA's example trajectories of Hera, by the release
notes in ANCDR/HERA/man/CReMA_2_0/Hera_2024_ECP_and_PDP_trajectory.zip."""


@pytest.mark.parametrize(
    ("body", "doubted"), [("Didymos", True), ("Didymos Barycenter", False), ("65803", None)]
)
def test_an_oem_about_a_systems_barycentre_is_read_with_a_doubt(body, doubted):
    pytest.importorskip("oem")
    Path("hera.oem").write_text(HERA, encoding="ascii")
    if doubted is None:
        with pytest.raises(InputError, match="CENTER_NAME: got DidymosBarycenter; must be 65803"):
            oem_track(Path("hera.oem"), body)
        return
    track = oem_track(Path("hera.oem"), body)
    assert track.epoch == datetime(2027, 2, 1)
    np.testing.assert_array_equal(track.times_s, [0.0, 3600.0, 7200.0])
    np.testing.assert_allclose(track.states[1], [9640.0, -1928.0, 1500.0, -0.1, 0.02, 0.0])
    assert ["about DidymosBarycenter" in str(doubt) for doubt in track.doubts] == [True] * doubted


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


@pytest.fixture(scope="module")
def track(export, tmp_path_factory) -> Track:
    path = tmp_path_factory.mktemp("track") / "plan.csv"
    path.write_text(csv_text(export), encoding="utf-8")
    return csv_track(path, export.mission.scenario.epoch.tdb)


def test_what_bends_otherwise_than_the_body_pulls_is_told(export, track):
    """Another body's; metres that are kilometres; axes that turn, with their own velocities."""
    assert not list(step_doubts(track))
    assert not list(pull_doubts(export.mission, track))
    rotation = export.mission.rotation
    to_body = np.array([rotation.body_to_j2000(time).T for time in track.times_s])
    turned = np.einsum("nij,nkj->nki", to_body, track.states.reshape(-1, 2, 3))
    turned[:, 1] -= np.cross([0.0, 0.0, rotation.rate], turned[:, 0])
    slower = track.states * ([1.0] * 3 + [0.5] * 3)
    for wrong in (
        replace(track, times_s=2.0 * track.times_s, states=slower),
        replace(track, states=1e3 * track.states),
        replace(track, states=turned.reshape(-1, 6)),
    ):
        (doubt,) = pull_doubts(export.mission, wrong)
        assert "from that by Bennu and sunlight" in str(doubt)


def test_an_epoch_in_utc_for_a_table_in_tdb_is_refused(export):
    Path("plan.csv").write_text(csv_text(export), encoding="utf-8")
    epoch = export.mission.scenario.epoch.tdb
    with pytest.raises(InputError, match=r"epoch: .*69\.184 s later.*column tdb"):
        csv_track(Path("plan.csv"), epoch - timedelta(seconds=69.184))


def test_gaps_and_states_that_are_elsewhere_are_told(track):
    kept = (track.times_s < 12_000.0) | (track.times_s > 14_000.0)
    gap = replace(track, times_s=track.times_s[kept], states=track.states[kept])
    assert "without a state from" in str(next(step_doubts(gap)))
    states = track.states.copy()
    states[0, 0] += 100.0
    assert "positions jump" in str(next(step_doubts(replace(track, states=states))))


def test_ends_that_are_not_those_asked_for_are_told(track):
    begin = track.epoch + timedelta(seconds=float(track.times_s[3]) - 30.0)
    told = cut(track, begin, track.epoch + timedelta(seconds=1e6)).doubts
    assert [doubt.entry for doubt in told] == ["--from", "--to"]
    assert "a time 30.000 s before" in told[0].given
    assert not cut(track, track.epoch, None).doubts
