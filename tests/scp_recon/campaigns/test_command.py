"""The command: what it says, when it refuses, and that it goes on where it was stopped."""

import json
import signal
from pathlib import Path

import pytest

from scp_recon.campaigns import page
from scp_recon.campaigns.run import executor_of, read_results
from scp_recon.campaigns.study import Study
from scp_recon.cli.commands import campaign as command
from scp_recon.cli.views import time_left
from scp_recon.jobs.job import here
from scp_recon.jobs.processes import Processes
from scp_recon.jobs.store import Store
from scp_recon.results.read import read_solution
from tests.scp_recon.campaigns.shown import table_of

pytestmark = pytest.mark.slow

STUDY = """
[campaign]
keep_solutions = true
overrides = { "grid.step_max_s" = 450.0 }
[[axis]]
entry = "boundary.final_position_m"
values = [[1.0, 2.0, 3.0], [19.9, 1128.7, -140.9]]
"""
REFUSED = """
[[axis]]
entry = "observation.incidence_max_deg"
grid = { from = 0.01, to = 0.02, count = 40 }
"""
"""A mission that is never lit: each case is refused in no time."""


def written(path: Path, text: str) -> str:
    path.write_text(text, encoding="utf-8")
    return str(path)


@pytest.mark.parametrize(
    ("done", "total", "took_s", "said"),
    [
        (0, 6, 9.0, ""),
        (6, 6, 9.0, ""),
        (1, 6, 27.0, "about 2.2 min left"),
        (1, 3, 30.0, "about 60 s left"),
        (2, 1002, 20.0, "about 2.8 h left"),
        (99, 100, 1.0, "about 1 s left"),
    ],
)
def test_time_left_is_said_after_the_first_case(done, total, took_s, said):
    assert time_left(done, total, took_s) == said


def test_campaign_runs_without_the_report_extra(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(page, "has_extras", lambda: False)
    text = REFUSED.replace("count = 40", "count = 2")
    study, out = written(tmp_path / "study.toml", text), tmp_path / "out"
    assert command.main([study, "--out", str(out), "--workers", "0"]) == 0
    said = capsys.readouterr().out
    assert "0 feasible of 2 cases" in said
    assert "no campaign.html" in said


def test_study_writes_table_and_solutions(tmp_path, capsys):
    study, out = written(tmp_path / "study.toml", STUDY), tmp_path / "out"
    assert command.main([study, "--out", str(out), "--workers", "0", "--json"]) == 0
    said = capsys.readouterr()
    document = json.loads(said.out)
    assert document["command"] == "campaign"
    assert document["statuses"] == {"converged": 1, "refused": 1}
    assert document["ends"] == {"feasible": 1, "no mission": 1}
    assert document["remarks"][-1].startswith("No mission: boundary.final_position_m: got ")
    assert document["remarks"][-1] in said.err
    rows = read_results(out)
    assert list(rows.status) == ["refused", "converged"]
    assert "boundary.final_position_m" in rows.message[0]
    assert json.loads(rows["boundary.final_position_m"][1]) == [19.9, 1128.7, -140.9]
    solution = read_solution(out / "solutions" / "case-0000001")
    assert (solution.plan_hash, solution.total_dv_m_s) == (rows.plan_hash[1], rows.total_dv_m_s[1])
    assert solution.verification.ok
    assert rows.verdict[1] == "verified"
    assert rows.probability[1] == min(p.estimate for p in solution.verification.probabilities)


@pytest.mark.parametrize(
    ("limits", "said"),
    [
        ({}, []),
        ({"limit_s": 5.0}, ["limit_s: not kept with --workers 0, where no case can be ended"]),
    ],
)
def test_limits_without_processes_are_reported(limits, said):
    study, heard = Study.validated({"campaign": limits}), list[str]()
    assert executor_of(study, 0, None, heard.append) is here
    assert heard == said
    assert isinstance(executor_of(study, 1, None, heard.append), Processes)
    assert heard == said


def test_interrupted_campaign_keeps_rows_and_continues(tmp_path, monkeypatch, capsys):
    """Ctrl-C with the third row, and a termination with the fifth, of a real process."""
    text = REFUSED.replace("count = 40", "count = 7")
    study, out, put = written(tmp_path / "study.toml", text), tmp_path / "out", Store.put

    for rows, number in ((3, signal.SIGINT), (5, signal.SIGTERM)):

        def stopped(store, *row, rows=rows, number=number):
            put(store, *row)
            if len(store) == rows:
                signal.raise_signal(number)

        with monkeypatch.context() as patch:
            patch.setattr(Store, "put", stopped)
            assert command.main([study, "--out", str(out), "--workers", "1"]) == 130
        said = capsys.readouterr().err
        assert "interrupted" in said
        assert "same command continues" in said
        assert signal.getsignal(signal.SIGTERM) is signal.SIG_DFL
        kept = read_results(out)
        assert len(kept) == rows
    for folder in (out, tmp_path / "b"):
        assert command.main([study, "--out", str(folder), "--workers", "0", "--quiet"]) == 0
    assert table_of(out).equals(table_of(tmp_path / "b"))
    whole = read_results(out)
    assert len(whole) == 7
    assert whole[whole.case.isin(kept.case)].reset_index(drop=True).equals(kept)
