"""`python -m scp_recon windows`: table, CSV, chart, and what it refuses."""

import csv
from functools import partial

import pytest

from scp_recon.cli.commands import windows
from tests.scp_recon.support import status_of

run = partial(status_of, windows.main)


def test_wrong_pole_is_warned_about_small_radius_refused(tmp_path, capsys):
    path = tmp_path / "mine.toml"
    path.write_text('base = "recon_b"\n[body]\npole_dec_deg = 60.3586\n', "utf-8")
    assert run(str(path), "--span-days", "0.2") == 0
    said = " ".join(capsys.readouterr().out.split())
    assert "warning: body.pole_ra_deg: got (85.46097, 60.3586) deg, 120.7 deg off" in said
    path.write_text('base = "recon_b"\n[safety]\nradius_min_m = 0.5\n', "utf-8")
    assert run(str(path), "--span-days", "0.2") == 2
    assert "safety.radius_min_m: got 0.5 m" in capsys.readouterr().err


def test_windows_before_and_after_epoch_are_tabulated(tmp_path, mission, capsys):
    """Of a scenario whose own burns are illegal, too."""
    scenario, path = tmp_path / "mine.toml", tmp_path / "w.csv"
    scenario.write_text('base = "recon_b"\nburns.times_s = [0.0, 13500.0, 20000.0, 40000.0]\n')
    assert run(str(scenario), "--from", "2020-01-20T00:00:00", "--span-days", "3") == 0
    assert "2020-01-20T" in capsys.readouterr().out
    assert run("recon_b", "--span-days", "1", "--csv", str(path)) == 0
    assert "1 2020-01-22T00:12:17 13140.2 16537.5 3397.3 48.87 8.48 to 13.75" in " ".join(
        capsys.readouterr().out.split()
    )
    rows = list(csv.DictReader(path.read_text("utf-8").splitlines()))
    edges = [float(rows[0][name]) for name in ("opens_s", "closes_s")]
    assert edges == pytest.approx(mission.schedule.window_s, abs=0.01)
    for row in rows:
        for i in range(1, 5):
            assert float(row[f"burn_{i}_earliest_s"]) < float(row[f"burn_{i}_latest_s"])


def test_a_site_without_windows_says_so(tmp_path, capsys):
    pytest.importorskip("matplotlib", reason="needs the extra [report]")
    dark, always = tmp_path / "dark.toml", tmp_path / "always.toml"
    dark.write_text('base = "recon_b"\n[observation]\nincidence_max_deg = 5.0\n', "utf-8")
    always.write_text(
        'base = "recon_b"\n[observation]\nincidence_max_deg = 180.0\nlocal_solar_time_min_h = 0.0\n'
        "local_solar_time_max_h = 24.0\n",
        "utf-8",
    )
    assert run(str(dark), "--chart", str(tmp_path / "dark.png")) == 0
    assert "no whole window" in capsys.readouterr().out
    assert run(str(always)) == 0
    assert "hold throughout" in capsys.readouterr().out
