"""The shell of the studies: options, finished work, what is written; tests counted."""

import inspect
import json
from argparse import Namespace
from pathlib import Path

from rich.console import Console

from experiments import frontier, testing
from experiments.__main__ import STUDIES, main
from experiments.evidence import FILE, ROOT, Evidence
from experiments.harness import Findings, Record, Session, Study, run, study_of
from experiments.other_tools import cross_check
from scp_recon.jobs.job import Job
from tests import reliability


def test_a_study_leaves_tables_and_origin(tmp_path):
    def study(session: Session) -> Findings:
        rows: list[Record] = session.rows(
            "rows", lambda x: {"x": x}, [Job(1, 1.5)], session.store("kept.jsonl")
        )
        return Findings({"rows": rows, "long": [{"i": i} for i in range(1000)]})

    found = []
    for _ in range(2):
        words = ["--out", str(tmp_path), "--quiet"]
        assert run("python -m experiments some", Study("", study), words) == 0
        found.append(Evidence.read(tmp_path / FILE))
    assert found[0].tables == {"rows": [{"x": 1.5}]}
    assert [one.resumed for one in found] == [False, True]
    (tmp_path / "map").mkdir()
    (tmp_path / "map" / "campaign.json").write_text("{}")
    words = ["--out", str(tmp_path), "--quiet"]
    none = Study("", lambda _: Findings({}))
    assert run("python -m experiments some", none, words) == 0
    assert Evidence.read(tmp_path / FILE).resumed
    assert found[0].command == "experiments some"


def session_in(out: Path, name: str = "study", version: int = 1) -> Session:
    """A session of a study that writes into a folder, in silence."""
    return Session(name, Namespace(), out, Console(quiet=True), Evidence.begun(name, version))


def test_finished_rows_depend_on_version_and_settings(tmp_path):
    def count(version: int, flights: int) -> int:
        session = session_in(tmp_path, version=version)
        with session.stores:
            store = session.store("kept.jsonl", flights=flights)
            return len(store) or store.put(0, {}) or 0

    assert [count(1, 10), count(1, 10), count(2, 10), count(2, 20)] == [0, 1, 0, 0]


PACKAGE = Path(frontier.__file__).parent


def test_every_study_is_listed(capsys):
    having = {path for path in PACKAGE.rglob("*.py") if "\nSTUDY = " in path.read_text("utf-8")}
    runs = {study_of(name).run for name in STUDIES}
    assert len(runs) == len(STUDIES)
    assert {Path(inspect.getfile(run)) for run in runs} == having
    assert main([]) == 0
    said = capsys.readouterr().out
    assert all(f"  {name} " in said for name in STUDIES)
    assert main(["no_such_study"]) == 2
    assert "battery_cones" in capsys.readouterr().err


def test_a_study_is_one_document_or_silent(tmp_path, capsys, monkeypatch):
    words = ["cross_check", "--out", str(tmp_path)]
    found = Findings({"rows": [{"x": 1}]})
    monkeypatch.setattr(cross_check, "STUDY", Study("", lambda _: found))
    assert main([*words, "--json"]) == 0
    said = capsys.readouterr()
    document = json.loads(said.out)
    assert document["folder"] == str(tmp_path)
    assert "written: " in said.err
    assert main([*words, "--quiet"]) == 0
    assert capsys.readouterr() == ("", "")
    assert {str(path) for path in tmp_path.iterdir()} == set(document["files"])


def evidence_of(what: str, out: Path) -> dict[str, dict[str, object]]:
    words = [what, "--out", str(out), "--quiet"]
    assert run("python -m experiments testing", testing.STUDY, words) == 0
    rows = Evidence.read(out / FILE).tables[what]
    return {str(next(iter(row.values()))): dict(row) for row in rows}


def test_counts_of_property_tests_are_rows(tmp_path, monkeypatch):
    def pytest_run(words, statuses, folder, setting):
        assert (folder, setting["HYPOTHESIS_PROFILE"]) == (ROOT, "nightly")
        assert 1 in statuses, "failed tests are counted"
        path = next(Path(w.rpartition("=")[2]) for w in words if "--reliability=" in w)
        reliability.write(path, reliability.Counter({reliability.SOLVED: 10}))
        return {}, ""

    monkeypatch.setattr(testing, "run_python", pytest_run)
    assert evidence_of("reliability", tmp_path)[reliability.SOLVED]["all"] == 10


def test_mutants_are_drawn_tried_and_counted(tmp_path, monkeypatch):
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
    assert found["all"]["tried"] == 2 * testing.DRAWN == 60 - tried["not checked"]
    assert found["all"]["found_out"] == tried["killed"]
    assert found["all"]["share_low"] < found["all"]["share"] < found["all"]["share_high"]  # type: ignore[operator]
    named = [name for row in found.values() for name in str(row["survivors"] or "").split("; ")]
    assert sorted(filter(None, named)) == sorted(n for n, e in ends.items() if e == "survived")
