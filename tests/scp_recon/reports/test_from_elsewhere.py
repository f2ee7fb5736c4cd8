"""The report from where plans are made: `solve --report`, and the front door."""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import Any

import pytest

import scp_recon as sr
from scp_recon.reports import flights
from scp_recon.reports.flights import fly
from tests.scenarios import COARSE
from tests.scp_recon.support import fly_few, run_solve

door: Any = sr


@pytest.fixture(autouse=True)
def few_flights(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(flights, "fly", partial(fly, samples=200))
    fly_few(monkeypatch)


def test_solve_writes_it_beside_the_plan_and_one_of_a_failed_plan_beside_that(
    tmp_path: Path,
) -> None:
    run = run_solve(tmp_path, "--report")
    assert run.exit_code == 0
    page = (tmp_path / "report.html").read_text("utf-8")
    assert "<strong>verified</strong>" in page
    assert run.output.rstrip().endswith(f"written: {tmp_path / 'report.html'}")
    impossible = ("--problem", "P3", "--set", "burns.dv_max_m_s=0.02", "--set", COARSE)
    assert run_solve(tmp_path, *impossible, "--report").exit_code == 3
    assert (tmp_path / "report.html").read_text("utf-8") == page
    other = (tmp_path / "report_unverified.html").read_text("utf-8")
    assert "<strong>not verified: status" in other
    assert "violated by up to" in other
