"""The shell of the studies: options, finished work, what is written; tests counted."""

import json
import re
from pathlib import Path

import numpy as np
import pytest

from experiments import harness, other_tools, testing
from experiments.__main__ import main
from experiments.evidence import FILE, MODULES, ROOT, SOURCES, STUDIES, Evidence
from experiments.harness import Record, Session, Study, Tables, run, study_of, write
from tests import reliability


@pytest.mark.parametrize(("version", "again"), [(1, [2.0]), (2, [1.5, 2.0])])
def test_stopped_study_measures_missing_rows(tmp_path, version, again):
    """Those of its version; a finished one measures all."""
    tried: list[float] = []

    def measure(x: float) -> Record:
        tried.append(x)
        if tried == [1.5, 2.0]:
            raise KeyboardInterrupt
        return {"x": x}

    def tables(session: Session) -> Tables:
        return {"rows": session.rows("rows", measure, [1.5, 2.0]), "long": [{"i": 0}] * 1000}

    words = ["--out", str(tmp_path), "--quiet"]
    for number, status in ((1, 130), (version, 0), (version, 0)):
        study = Study("", tables, version=number)
        assert run("python -m experiments some", study, words) == status
    assert tried == [1.5, 2.0, *again, 1.5, 2.0]
    found = Evidence.read(tmp_path / FILE)
    assert (found.command, found.version) == ("experiments some", version)
    assert found.tables == {"rows": [{"x": 1.5}, {"x": 2.0}]}


def test_cells_are_written_as_they_are(tmp_path):
    rows = [{"n": 3, "ok": np.True_, "off": np.inf}, {"n": None, "x": np.float64(0.1)}]
    write(tmp_path, {"rows": rows}, Evidence.begun("some", 1))
    assert Evidence.read(tmp_path / FILE).tables["rows"] == [
        {"n": 3, "ok": True, "off": None, "x": None},
        {"n": None, "ok": None, "off": None, "x": 0.1},
    ]
    assert (tmp_path / "rows.csv").read_text() == "n,ok,off,x\n3,True,inf,\n,,,0.1\n"


def test_every_study_is_listed(capsys):
    package = Path(harness.__file__).parent
    texts = {path: path.read_text("utf-8") for path in package.rglob("*.py")}
    having = {path for path, text in texts.items() if re.search(r'^STUDIES = {\s*"', text, re.M)}
    assert {package.joinpath(*name.split(".")).with_suffix(".py") for name in MODULES} == having
    assert all(study_of(name).about for name in STUDIES)
    commands = [source.command.split() for source in SOURCES.values()]
    assert {words[1] for words in commands if words[0] == "experiments"} == set(STUDIES)
    assert main([]) == 0
    said = capsys.readouterr().out
    assert all(f"  {name} " in said for name in STUDIES)
    assert main(["no_such_study"]) == 2
    assert "battery_cones" in capsys.readouterr().err


def test_a_study_is_one_document_or_silent(tmp_path, capsys, monkeypatch):
    words = ["cross_check", "--out", str(tmp_path)]
    study = Study("", lambda _: {"rows": [{"x": 1}]})
    monkeypatch.setitem(other_tools.STUDIES, "cross_check", study)
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
    assert run("python -m experiments testing", testing.STUDIES["testing"], words) == 0
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
