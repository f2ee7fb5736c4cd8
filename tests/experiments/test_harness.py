"""The shell of the studies: one way in, --json and --quiet, claims as rows, work taken up again."""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Any

import pytest

from experiments import frontier
from experiments.__main__ import STUDIES, main, module_of
from experiments.harness import Claim, Findings, report
from experiments.timing_rules import SETTLED
from scp_recon.jobs.store import Store
from scp_recon.results.table import Table

PACKAGE = Path(frontier.__file__).parent


def test_every_study_is_listed(capsys: pytest.CaptureFixture[str]) -> None:
    having = {path for path in PACKAGE.rglob("*.py") if "\nSTUDY = " in path.read_text("utf-8")}
    places = {PACKAGE.parent.joinpath(*module_of(name).split(".")) for name in STUDIES}
    assert {place.with_suffix(".py") for place in places} == having
    assert main([]) == 0
    said = capsys.readouterr().out
    assert all(f"  {name} " in said for name in STUDIES)
    assert main(["no_such_study"]) == 2
    assert "battery_cones" in capsys.readouterr().err


@pytest.mark.parametrize("study", STUDIES)
def test_a_command_line_that_cannot_be_read_is_a_document(
    study: str, capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(SystemExit) as end:
        main([study, "--no-such-option", "--json"])
    assert end.value.code == 2
    document = json.loads(capsys.readouterr().out)
    assert document["command"] == f"experiments {study}"


def test_a_study_is_one_document_or_silent(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    words = ["battery_cones", "--samples", "100", "--out", str(tmp_path)]
    assert main([*words, "--json"]) == 0
    said = capsys.readouterr()
    document = json.loads(said.out)
    assert document["folder"] == str(tmp_path)
    assert [claim["holds"] for claim in document["claims"]] == [False, True, True]
    assert "written: " in said.err
    assert main([*words, "--quiet"]) == 0
    assert capsys.readouterr() == ("", "")
    assert {str(path) for path in tmp_path.iterdir()} == set(document["files"])


def test_a_report_ends_with_the_claims_a_row_each() -> None:
    claims = [Claim("a is b", "within 1", "0.5", True), Claim("c", "all", "none", None)]
    text = report("Title", Findings(["Words.", Table.of("Part", ["x"], [["y"]])], {}, claims))
    assert text.startswith("# Title\n\nWords.\n\n## Part\n\n| x |")
    assert text.endswith("| a is b | within 1 | 0.5 | yes |\n| c | all | none | not tested |\n")


def test_the_frontier_goes_on_after_ctrl_c(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(frontier, "KINDS", dict(list(frontier.KINDS.items())[:2]))
    planned: list[str] = []

    def made(kind: str, p: float, *_: object) -> dict[str, Any]:
        if len(planned) == 1 and not (tmp_path / "pressed").exists():
            (tmp_path / "pressed").touch()
            raise KeyboardInterrupt
        planned.append(f"{kind} {p:g}")
        figures = ("certified_low", "node", "whole_flight", "observed_mean_s", "seconds")
        return {
            "kind": kind, "asked": p, "status": "converged", "total_dv_m_s": 0.1, "aim": math.nan,
            **dict.fromkeys(figures, 0.5),
        }  # fmt: skip

    monkeypatch.setattr(frontier, "_row", made)
    words = ["frontier", "--quick", "--out", str(tmp_path)]
    assert main(words) == 130
    assert (tmp_path / "frontier_partial.jsonl").exists()
    assert main(words) == 0
    assert len(planned) == len(set(planned)) == 4
    assert not (tmp_path / "frontier_partial.jsonl").exists()
    assert capsys.readouterr().out.count("0.10000 m/s") == 5


def test_a_slew_is_kept_whole(tmp_path: Path) -> None:
    slew = {"axis_x": 0.6, "wheel_share": 0.25, **dict.fromkeys(SETTLED.values(), math.inf)}
    slew["steady_rms_deg"] = 1 / 3
    with Store(tmp_path / "partial.jsonl", {}) as store:
        assert store.row("0", lambda: slew) == slew
    with Store(tmp_path / "partial.jsonl", {}) as store:
        assert store["0"] == slew
