"""The study of the tests: counts from what the tools leave behind."""

from __future__ import annotations

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
