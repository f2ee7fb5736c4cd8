"""Tracks of other tools: what is read of an OEM or a table, what is refused, and what is doubted."""

from dataclasses import replace
from datetime import datetime, timedelta
from pathlib import Path

import numpy as np
import pytest

from scp_recon.bodies.catalogue import J2000_TDB
from scp_recon.drafting.draft import Track
from scp_recon.errors import InputError
from scp_recon.interop.ccsds import oem_track
from scp_recon.interop.files import csv_text
from scp_recon.interop.tracks import csv_track, cut, pull_doubts, step_doubts


@pytest.fixture(autouse=True)
def _elsewhere(monkeypatch, tmp_path) -> None:
    monkeypatch.chdir(tmp_path)


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


COVARIANCE = """COVARIANCE_START
EPOCH = 2027-02-01T00:00:00
1e-4
0.0 1e-4
0.0 0.0 1e-4
0.0 0.0 0.0 1e-8
0.0 0.0 0.0 0.0 1e-8
0.0 0.0 0.0 0.0 0.0 1e-8
COVARIANCE_STOP
"""
AT_ONE = "2027-02-01T01:00:00.000000"


def hera(*changes: tuple[str, str], path: Path = Path("hera.oem")) -> Path:
    """The file with texts replaced, as `"META_STOP"` by a text to put in."""
    text = HERA + COVARIANCE
    for old, new in changes:
        assert old in text
        text = text.replace(old, new)
    path.write_text(text, encoding="utf-8")
    return path


@pytest.mark.parametrize(
    ("changes", "scale_s"),
    [
        ([], 0.0),
        ([("CCSDS_OEM_VERS", "\ufeff\n\n  CCSDS_OEM_VERS")], 0.0),
        ([("00.000000", "00.000000Z"), ("00:00\n1e-4", "00:00Z\n1e-4")], 0.0),
        ([("2027-02-01T", "2027-032T")], 0.0),
        ([("2027-02-01T", "2027-032T"), ("00.000000", "00Z")], 0.0),
        ([("= TDB", "= UTC"), ("00.000000", "00Z")], 69.184),
        ([("= TDB", "= tai")], 32.184),
        ([("= TDB", "= TT")], 0.0),
        ([("2.0e-5  0.0\n", "2.0e-5  0.0 0.0 0.0 0.0\n")], 0.0),
        ([("VERS = 2.0", "VERS = 3.0"), ("REF_FRAME      = EME2000", "REF_FRAME = ICRF")], 0.0),
    ],
)
def test_an_oem_is_read_in_every_form(changes, scale_s):
    track = oem_track(hera(*changes), "Didymos")
    off = (track.epoch - datetime(2027, 2, 1)).total_seconds()
    assert off == pytest.approx(scale_s, abs=0.002)  # TDB is within 2 ms of TT
    np.testing.assert_allclose(track.times_s, [0.0, 3600.0, 7200.0], atol=1e-6)
    np.testing.assert_allclose(track.states[1], [9640.0, -1928.0, 1500.0, -0.1, 0.02, 0.0])


@pytest.mark.parametrize("scale", ["UTC", "TDB", "TT", "TAI"])
def test_oems_agree_with_another_reader(scale, tmp_path):
    """Key-value notation and XML, and dates of all scales."""
    oem, time = pytest.importorskip("oem"), pytest.importorskip("astropy.time")
    path = hera(("TIME_SYSTEM    = TDB", f"TIME_SYSTEM = {scale}"))
    other = oem.OrbitEphemerisMessage.open(str(path))
    other.save_as(str(tmp_path / "hera.xml"), file_format="xml")
    expected = [(state.epoch - time.Time(J2000_TDB, scale="tdb")).sec for state in other.states]
    for file in (path, tmp_path / "hera.xml"):
        track = oem_track(file, "Didymos")
        since = (track.epoch - J2000_TDB).total_seconds()
        np.testing.assert_allclose(since + track.times_s, expected, atol=1e-4)
        states = [1e3 * np.concatenate([one.position, one.velocity]) for one in other.states]
        np.testing.assert_allclose(track.states, states, rtol=1e-12)


@pytest.mark.parametrize(
    ("old", "new", "where", "allowed"),
    [
        # text, what stands in its place, key and line, words on what is allowed
        ("REF_FRAME      = EME2000", "REF_FRAME = TEME", "REF_FRAME, line 9", "EME2000 or"),
        ("2000-01-01T12", "2020-01-01T12", "REF_FRAME_EPOCH, line 10", "2000-01-01T12"),
        ("2000-01-01T12:00:00.000", "2000-01-01", "REF_FRAME_EPOCH, line 10", "2000-01-01T12"),
        ("= TDB", "= GPS", "TIME_SYSTEM, line 11", "UTC or TDB or TT or TAI"),
        ("TIME_SYSTEM    = TDB\n", "", "TIME_SYSTEM, metadata", "UTC or TDB"),
        ("DidymosBarycenter", "EARTH", "CENTER_NAME, line 8", "DIDYMOS"),
        ("VERS = 2.0", "VERS = 4.0", "line 1", "1.0 or 2.0 or 3.0"),
        ("CCSDS_OEM_VERS = 2.0\n", "", "line 1", "CCSDS_OEM_VERS"),
        ("0.0 0.0 1e-4\n", "0.0 0.0 1e-4 0 0 0 0\n", "line 23", "each a number longer"),
        ("0.0 1e-8\nCOV", "0.0 1e-8\n0 0 0 0 0 0 1\nCOV", "line 27", "triangle of 6 rows"),
        ("EPOCH = 2027-02-01T00:00:00\n", "", "line 20", "after its EPOCH"),
        ("EPOCH = 2027-02-01T00:00:00\n", "EPOCH = today\n", "line 20", "an epoch such as"),
        ("0.0 0.0 1e-4\n", "0.0 none 1e-4\n", "line 23", "finite numbers"),
        ("0.0 0.0 0.0 0.0 0.0 1e-8\n", "", "line 26", "follow all 6 rows"),
        ("COVARIANCE_STOP\n", "", "line 26", "followed by COVARIANCE_STOP"),
        ("= EME2000\n", "= ITRF93\nREF_FRAME = EME2000\n", "line 10", "given once"),
        ("TIME      = 2027-02-01T02:00", "TIME = 2 h", "STOP_TIME, line 13", "a date"),
        (AT_ONE, "2027-02-01T00:00:00.0", "line 17", "later than the state before"),
        (AT_ONE, "2027-02-01T02:30:00.0", "line 18", "later than the state before"),
        (AT_ONE, "2027-02-30T01:00:00.0", "line 17", "epoch"),
        (AT_ONE, "2027-366T01:00:00.0", "line 17", "epoch"),
        (AT_ONE, "yesterday", "line 17", "epoch"),
        ("9.64 ", "nan", "line 17", "finite"),
        ("9.64 ", "", "line 17", "six numbers"),
        ("9.64 ", "x", "line 17", "numbers"),
        ("META_STOP", "META_STOP\nMETA_START\nMETA_STOP", "REF_FRAME, metadata", "EME2000"),
    ],
)
def test_faults_of_an_oem_are_named_by_line(old, new, where, allowed):
    with pytest.raises(InputError, match=allowed) as caught:
        oem_track(hera((old, new)), "Didymos")
    assert caught.value.entry.endswith(where)
    assert "\n" not in str(caught.value)


def test_states_ending_before_stated_stop_are_doubted():
    (doubt,) = oem_track(
        hera(("2027-02-01T02:00:00.000000  9.28", "COMMENT")), "didymosbarycenter"
    ).doubts
    assert (doubt.given, doubt.expected) == (
        "states that end at 2027-02-01T01:00:00.000000",
        "expected STOP_TIME, 2027-02-01T02:00:00.000000",
    )
    assert not oem_track(
        hera(("T02:00:00.000000\nMETA", "T02:00:00.4\nMETA")), "didymosbarycenter"
    ).doubts


def test_segments_meet_at_burns_in_order():
    again = HERA.partition("\n\n")[2]
    for old, new in (("T02:", "T03:"), ("T00:", "T02:"), ("T01:00", "T02:30")):
        again = again.replace(old, new)
    path = hera(("COVARIANCE_START", f"{again}COVARIANCE_START"))
    times = oem_track(path, "Didymos").times_s
    assert times.tolist() == [0.0, 3600.0, 7200.0, 7200.0, 9000.0, 10_800.0]
    early = again.replace("T02:", "T01:")
    with pytest.raises(InputError, match="later than") as caught:
        oem_track(hera(("COVARIANCE_START", f"{early}COVARIANCE_START")), "Didymos")
    assert caught.value.entry.endswith("line 30")


@pytest.mark.parametrize(
    ("body", "doubted"), [("Didymos", True), ("Didymos Barycenter", False), ("65803", None)]
)
def test_oem_about_a_barycentre_is_doubted(body, doubted):
    path = hera()
    if doubted is None:
        with pytest.raises(InputError, match=r"got DidymosBarycenter; .* 65803") as caught:
            oem_track(path, body)
        assert caught.value.entry.endswith("CENTER_NAME, line 8")
        return
    doubts = oem_track(path, body).doubts
    assert ["about DidymosBarycenter" in str(doubt) for doubt in doubts] == [True] * doubted


@pytest.fixture(scope="module")
def track(export, tmp_path_factory) -> Track:
    path = tmp_path_factory.mktemp("track") / "plan.csv"
    path.write_text(csv_text(export), encoding="utf-8")
    return csv_track(path, export.mission.scenario.epoch.tdb)


def test_wrong_curvature_of_a_track_is_doubted(export, track):
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
        assert "by Bennu and sunlight" in str(doubt)


def test_utc_epoch_of_a_tdb_table_is_refused(export):
    Path("plan.csv").write_text(csv_text(export), encoding="utf-8")
    epoch = export.mission.scenario.epoch.tdb
    with pytest.raises(InputError, match=r"epoch: .*69\.184 s later.*column tdb"):
        csv_track(Path("plan.csv"), epoch - timedelta(seconds=69.184))


def test_gaps_and_jumps_of_a_track_are_reported(track):
    kept = (track.times_s < 12_000.0) | (track.times_s > 14_000.0)
    gap = replace(track, times_s=track.times_s[kept], states=track.states[kept])
    assert "without a state from" in str(next(step_doubts(gap)))
    states = track.states.copy()
    states[0, 0] += 100.0
    assert "positions jump" in str(next(step_doubts(replace(track, states=states))))


def test_ends_other_than_asked_are_reported(track):
    begin = track.epoch + timedelta(seconds=float(track.times_s[3]) - 30.0)
    told = cut(track, begin, track.epoch + timedelta(seconds=1e6)).doubts
    assert [doubt.entry for doubt in told] == ["--from", "--to"]
    assert "a time 30.000 s before" in told[0].given
    assert not cut(track, track.epoch, None).doubts
