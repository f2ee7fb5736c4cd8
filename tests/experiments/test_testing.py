"""What the tests reach, counted from what the tools leave behind."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from experiments import testing
from experiments.evidence import FILE, Evidence
from experiments.harness import run
from tests import reliability


def evidence_of(what: str, out: Path) -> dict[str, dict[str, object]]:
    words = [what, "--out", str(out), "--quiet"]
    assert run("python -m experiments testing", testing.STUDY, testing.__name__, words) == 0
    rows = Evidence.read(out / FILE).tables[what]
    return {str(next(iter(row.values()))): dict(row) for row in rows}


def test_counts_of_all_seeds_are_added_and_a_stopped_run_goes_on(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    ran: list[int] = []

    def pytest_run(*words: str, profile: str) -> str:
        assert profile == "nightly"
        seed = next(int(w.rpartition("=")[2]) for w in words if "seed=" in w)
        ran.append(seed)
        if ran == [1, 2, 3]:
            raise KeyboardInterrupt
        path = next(Path(w.rpartition("=")[2]) for w in words if "--reliability=" in w)
        reliability.write(path, reliability.Counter({reliability.SOLVED: 10 * seed}))
        return ""

    monkeypatch.setattr(testing, "_pytest", pytest_run)
    with pytest.raises(AssertionError):
        evidence_of("reliability", tmp_path)
    row = evidence_of("reliability", tmp_path)[reliability.SOLVED]
    assert row["seed_4"] == 40
    assert row["all"] == 150
    assert ran == [1, 2, 3, 3, 4, 5]


def test_lines_and_branches_are_those_of_each_package(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def pytest_run(*words: str, profile: str) -> str:
        assert profile == "default"
        path = next(Path(w.rpartition(":")[2]) for w in words if "--cov-report" in w)
        files = {}
        for name, reached in (
            ("formulations/a.py", 8),
            ("scp_recon/b.py", 9),
            ("scp_recon/c.py", 5),
        ):
            lines = {"covered_lines": reached, "num_statements": 10}
            files[name] = {"summary": lines | {"covered_branches": 1, "num_branches": 2}}
        path.write_text(json.dumps({"files": files}), "utf-8")
        path.with_name("counts.json").write_text(json.dumps({reliability.FAULTS: 109}), "utf-8")
        return ""

    monkeypatch.setattr(testing, "_pytest", pytest_run)
    found = evidence_of("coverage", tmp_path)
    assert found["scp_recon"]["lines_share"] == 0.7
    assert found["formulations"]["branches_share"] == 0.5
    assert found[reliability.FAULTS]["count"] == 109


def test_mutants_are_drawn_tried_and_counted(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    ends = {f"formulations.{m}.x__mutmut_{k}": "not checked" for m in "ab" for k in range(30)}

    def mutmut(*words: str) -> str:
        for name in words[3:] if words[0] == "run" else ():
            if name in ends:
                ends[name] = {"0": "survived", "1": "no tests"}.get(name[-1], "killed")
        return "\n".join(f"    {name}: {end}" for name, end in ends.items())

    monkeypatch.setattr(testing, "_mutmut", mutmut)
    found = evidence_of("mutation", tmp_path)
    tried = {end: sum(e == end for e in ends.values()) for end in set(ends.values())}
    assert found["all"]["mutants"] == 60
    assert found["all"]["tried"] == 20 == 60 - tried["not checked"]
    assert found["all"]["found_out"] == tried["killed"]
    assert found["all"]["share_low"] < found["all"]["share"] < found["all"]["share_high"]  # type: ignore[operator]
    named = [name for row in found.values() for name in str(row["survivors"] or "").split("; ")]
    assert sorted(filter(None, named)) == sorted(n for n, e in ends.items() if e == "survived")
