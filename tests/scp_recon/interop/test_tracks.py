"""Tracks of other tools: what is read of an OEM or a table, what is refused, and what is doubted."""

from dataclasses import replace
from datetime import datetime, timedelta
from pathlib import Path

import numpy as np
import pytest

from scp_recon.drafting.flown import Track
from scp_recon.errors import InputError
from scp_recon.interop.ccsds import oem_text
from scp_recon.interop.files import csv_text
from scp_recon.interop.tracks import csv_track, cut, oem_track, pull_doubts, step_doubts


@pytest.fixture(autouse=True)
def _elsewhere(monkeypatch, tmp_path) -> None:
    monkeypatch.chdir(tmp_path)


@pytest.mark.slow
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
def test_oem_about_a_barycentre_is_doubted(body, doubted):
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


def test_nan_in_an_oem_is_named_by_line(tmp_path):
    pytest.importorskip("oem")
    file = tmp_path / "flight.oem"
    file.write_text(
        "CCSDS_OEM_VERS = 2.0\nCOMMENT nan is allowed here\nX = inf\n1 2 NaN 3\n", "utf-8"
    )
    with pytest.raises(InputError, match=r"flight\.oem, line 4: got 1 2 NaN 3; must be finite"):
        oem_track(file, "BENNU")


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
        assert "from that by Bennu and sunlight" in str(doubt)


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
