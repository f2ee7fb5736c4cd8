"""`python -m scp_recon new`: a file that solves, or that says what to change."""

import json
import tomllib
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import pytest

from scp_recon.api import drafts
from scp_recon.api.verbs import plan
from scp_recon.cli.commands import new
from scp_recon.cli.plan_view import as_given
from scp_recon.drafting import draft as drafting
from scp_recon.mission.scene import Scene
from scp_recon.scenario.load import load_scenario
from scp_recon.scp.status import Status
from scp_recon.verification.causes import Cause
from tests.helpers import usually
from tests.scp_recon.support import file_of, status_of

pytestmark = pytest.mark.slow

BENNU = ("--body", "Bennu", "--site", "55.9,41.8", "--epoch", "2020-01-21T20:33:17")
STONE = (
    *("--body", "Stone", "--site", "35,0", "--epoch", "2024-05-01", "--gm", "2.36"),
    *("--radius", "165", "--period", "12.1324", "--pole=90.53,-66.30"),
    "--orbit=150000000,90000000,40000000,-13.5,21.0,9.0",
)


@pytest.fixture(autouse=True)
def _elsewhere(monkeypatch, tmp_path) -> None:
    monkeypatch.chdir(tmp_path)


run = partial(status_of, new.main)


@pytest.mark.parametrize(
    "options", usually([BENNU, STONE], 1), ids=usually(["packaged", "by numbers"], 1)
)
def test_what_is_written_solves(options, capsys):
    assert run("mine", *options, "--json") == 0
    shown = capsys.readouterr()
    assert json.loads(shown.out)["plan"]["verification"]["ok"] is True
    assert "verified" in shown.err
    # What was planned is what the file holds, to the last digit.
    (line,) = [line for line in shown.err.splitlines() if line.startswith("total delta-v")]
    total = plan(load_scenario("mine.toml")).total_dv_m_s
    assert line.startswith(f"total delta-v {1e3 * total:.3f} mm/s")


def test_infeasible_draft_proposes_nothing_untried(monkeypatch, capsys):
    """As if the planner had found nothing: what is infeasible takes it long to tell."""
    planned = drafts._planned

    def infeasible(*given: Any) -> drafts.NewScenario:
        found = planned(*given)
        failed = replace(found.verification, failed=["status"], ok=False)
        status = Status.INFEASIBLE.value.name
        solution = replace(found.solution, status=status, verification=failed)
        return replace(found, solution=solution, verification=failed)

    monkeypatch.setattr(drafting, "HALF_WIDTHS_H", (4.0,))
    monkeypatch.setattr(drafts, "_planned", infeasible)
    assert run("mine", *BENNU) == 3
    said = capsys.readouterr().out
    assert "infeasible" in said
    written = Path("mine.toml").read_text("utf-8")
    assert f"status: {Cause.STATUS.value}" in said
    assert f"# status: {Cause.STATUS.value}" in written
    assert "no remedy was tried" in written
    assert "To change" not in written
    assert tomllib.loads(written)["name"] == "mine"


OTHER_WAY = {"body.pole_ra_deg": 265.46097, "body.pole_dec_deg": 60.3586}
FAR_SUN = {"sun.body_position_km": [302183638.0, 0.0, 0.0]}
OTHER_SPIN = {"body.prime_meridian_rate_deg_day": -2011.145755336826}


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({}, "turns in 4.296 h, backwards (its axis 178 deg off"),
        (OTHER_WAY | OTHER_SPIN, "turns in 4.296 h, backwards (its axis 178 deg off"),
        (OTHER_SPIN, "turns in 4.296 h, forwards (its axis 2 deg off"),
        (FAR_SUN, "the Sun is 2.020 au away, 2 deg south"),
    ],
)
def test_body_taken_as_given_is_described(changes, said, scenario):
    """No check tells its way of turning, its pole or its Sun from others."""
    assert said in as_given(Scene.of(file_of(scenario, changes, name="Other")))


def test_draft_is_not_planned_where_unwritable(capsys, monkeypatch):
    Path("mine.toml").write_text("mine", "utf-8")
    monkeypatch.setattr(drafts, "_planned", lambda _: pytest.fail("planned"))
    assert run("mine.toml/below", *BENNU) == 2
    assert "must be a folder" in capsys.readouterr().err
    assert run("mine", *BENNU) == run("mine.toml", *BENNU) == 2
    assert "must not exist" in capsys.readouterr().err
    assert Path("mine.toml").read_text("utf-8") == "mine"
