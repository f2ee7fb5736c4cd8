"""The shell of the studies and what they leave: evidence, the pages that show it, tests counted."""

import json
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from experiments import evidence, frontier, harness, pages, renewal, testing
from experiments.__main__ import STUDIES, main, module_of
from experiments.evidence import (
    FILE,
    SOURCES,
    UNKNOWN,
    Evidence,
    Source,
    out_of_date,
    path_of,
)
from experiments.harness import Findings, Record, Session, Study, plan_or_default, run
from experiments.spacecraft import battery_cones
from scp_recon.errors import InputError
from scp_recon.jobs import store
from scp_recon.jobs.job import Job
from scp_recon.results.table import Table
from scp_recon.scenario.load import load_scenario
from tests import reliability

from .support import session_in

QUICK = Source("experiments battery_cones --samples 100", (battery_cones.__name__,))


@pytest.fixture
def folder(tmp_path, monkeypatch) -> Path:
    """Where evidence goes, of one quick study, and one page."""
    page = tmp_path / "page.md"
    page.write_text("<!-- table cones.battery_cones -->\n<!-- end -->\n", "utf-8")
    (tmp_path / "tables.toml").write_text(
        '[cones.battery_cones]\ncolumns = "load_w:.0f"\n', "utf-8"
    )
    monkeypatch.setattr(pages, "TABLES", tmp_path / "tables.toml")
    monkeypatch.setattr(evidence, "FOLDER", tmp_path / "evidence")
    monkeypatch.setattr(evidence, "SOURCES", {"cones": QUICK})
    monkeypatch.setattr(pages, "PAGES", (page,))
    monkeypatch.setattr(renewal, "RUNS", tmp_path / "runs")
    monkeypatch.setattr(renewal, "_run", in_this_process)
    pages._tables.cache_clear()
    return tmp_path


def in_this_process(command: str, _: object) -> None:
    if main(command.split()[1:]):
        raise InputError(f"python -m {command}", "exit status 2", "must end with 0")


def begun(**changes: Any) -> Evidence:
    return replace(Evidence.begun(QUICK), tables={"cones": [{"mode": "a"}]}, **changes)


@pytest.mark.parametrize(
    ("changed", "counts"),
    [
        ("scp_recon/scp/loop.py", True),  # which it imports by way of `api`
        ("scp_recon/data/recon_b.toml", True),
        ("experiments/frontier.py", True),
        ("scp_recon/api/planning.py", False),
        ("scp_recon/cli/options.py", False),
        ("scp_recon/jobs/store.py", False),
        ("experiments/harness.py", False),
    ],
)
def test_the_hash_counts_scenarios_and_what_is_below_api(changed, counts, monkeypatch):
    def digest() -> str:
        names = (*SOURCES["frontier"].modules, *evidence.DATA)
        return store.sources.__wrapped__(*names, without=evidence.ABOVE)

    before, read = digest(), store._read

    def edited(root: Path, path: Path, wings: frozenset[str]) -> tuple[bytes, list[Path]]:
        content, imported = read(root, path, wings)
        return content + b"\nx = 1" * (path == root / changed), imported

    monkeypatch.setattr(store, "_read", edited)
    assert (digest() != before) == counts


@pytest.mark.parametrize(
    ("changes", "why"),
    [
        ({}, None),
        ({"sources": UNKNOWN}, "measured before sources were hashed"),
        ({"sources": "0" * 64}, "sources"),
        ({"versions": {"clarabel": "0.1"}}, "clarabel 0.1, now "),
        ({"command": "experiments battery_cones"}, "by experiments battery_cones"),
    ],
)
@pytest.mark.usefixtures("folder")
def test_what_has_changed_is_told(changes, why):
    assert out_of_date() == {"cones": "never measured"}
    path_of("cones").parent.mkdir()
    found = replace(begun(), **changes)
    assert Evidence.read(found.write(path_of("cones"))) == found
    said = out_of_date()
    assert (why is None) == (said == {})
    assert why is None or why in said["cones"]


def test_every_command_exists_and_every_file_has_its_command():
    for source in SOURCES.values():
        first, *words = source.command.split()
        if first == "experiments":
            assert words[0] in STUDIES
        for module in (*([] if first == "experiments" else [first]), *source.modules):
            place = evidence.ROOT.joinpath(*module.split("."))
            assert place.with_suffix(".py").exists() or place.is_dir()
    assert {path.stem for path in evidence.FOLDER.glob("*.json")} == set(SOURCES)


def test_a_study_leaves_its_tables_with_their_origin(tmp_path):
    def study(session: Session) -> Findings:
        rows: list[Record] = session.rows(
            "rows", lambda x: {"x": x}, [Job(1, 1.5)], session.store("kept.jsonl")
        )
        long = Table.of("long", ("i",), [(i,) for i in range(1000)])
        return Findings([long], {"rows.csv": Table.of_records("", rows)})

    found = []
    for _ in range(2):
        words = ["--out", str(tmp_path), "--quiet"]
        assert run("python -m experiments some", Study("", "", study), __name__, words) == 0
        found.append(Evidence.read(tmp_path / evidence.FILE))
    assert found[0].tables == {"rows": [{"x": 1.5}]}
    assert [one.resumed for one in found] == [False, True]
    (tmp_path / "map").mkdir()
    (tmp_path / "map" / "campaign.json").write_text("{}")
    words = ["--out", str(tmp_path), "--quiet"]
    none = Study("", "", lambda _: Findings([], {}))
    assert run("python -m experiments some", none, __name__, words) == 0
    assert Evidence.read(tmp_path / evidence.FILE).resumed
    assert found[0].command == "experiments some"
    assert found[0].sources == found[1].sources != UNKNOWN


def test_what_is_out_of_date_is_renewed_and_only_that(folder, capsys, monkeypatch):
    monkeypatch.setattr(renewal, "ROOT", folder)
    path_of("cones").parent.mkdir()
    old = {"battery_cones": [{"mode": "observation", "load_w": 90, "calibrated": False}]}
    replace(begun(seconds=90.0, sources="0" * 64), tables=old).write(path_of("cones"))
    assert main(["evidence", "--check"]) == renewal.OUT_OF_DATE
    said = capsys.readouterr().out
    assert "cones     sources" in said
    assert "page.md: its figures are not the evidence's" in said
    assert main(["evidence", "--page", "page.md"]) == 0
    said = capsys.readouterr().out
    assert "1.5" in said.split("python -m ")[0], "it says beforehand how many minutes it will take"
    found = Evidence.read(path_of("cones"))
    assert found.seconds < 90.0
    assert found.tables["battery_cones"][0]["mode"] == "delta-V, warm-up"
    assert "| 90 |" in (folder / "page.md").read_text("utf-8")
    assert main(["evidence", "--check"]) == 0
    assert main(["evidence"]) == 0
    assert "up to date" in capsys.readouterr().out


@pytest.mark.usefixtures("folder")
def test_a_study_that_fails_is_named_and_does_not_stop_the_others(capsys, monkeypatch):
    failing = {"none": QUICK._replace(command="experiments none")}
    monkeypatch.setattr(evidence, "SOURCES", failing | {"cones": QUICK})
    assert main(["evidence"]) == 2
    assert "none: python -m experiments none --out" in capsys.readouterr().out
    assert out_of_date() == {"none": "never measured"}


PACKAGE = Path(frontier.__file__).parent


def test_every_study_is_listed(capsys):
    having = {path for path in PACKAGE.rglob("*.py") if "\nSTUDY = " in path.read_text("utf-8")}
    places = {PACKAGE.parent.joinpath(*module_of(name).split(".")) for name in STUDIES}
    assert {place.with_suffix(".py") for place in places} == having
    assert main([]) == 0
    said = capsys.readouterr().out
    assert all(f"  {name} " in said for name in STUDIES)
    assert main(["no_such_study"]) == 2
    assert "battery_cones" in capsys.readouterr().err


@pytest.mark.parametrize(
    "words",
    [
        "battery_cones --samples 1",
        "observation_table --samples 1",
        "observation_table --samples x",
        "timing_rules --slews 2",
        "uncertainty_sources --paths 19",
    ],
)
def test_a_number_out_of_its_range_exits_with_two(words):
    with pytest.raises(SystemExit) as stop:
        main(words.split())
    assert stop.value.code == 2


def test_a_study_refuses_a_plan_that_it_would_fly_open_loop(monkeypatch):
    measured = {"navigation.sigma_position_m": 10.0, "navigation.sigma_velocity_m_s": 5e-4}
    scenario = load_scenario().replace({"policy.kind": "feedback", **measured})
    monkeypatch.setattr(harness, "read_solution", lambda _: SimpleNamespace(scenario=scenario))
    with pytest.raises(InputError, match=r"policy.kind: got 'feedback'; goes with"):
        plan_or_default(Path("of_one_s_own"))


def test_a_study_is_one_document_or_silent(tmp_path, capsys):
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


def test_what_was_kept_goes_once_the_tables_have_it(tmp_path):
    with session_in(tmp_path) as session:
        for file in ("", "stays.jsonl"):
            session.store(file).put(0, {})
        session.end(Study("", "", lambda _: Findings([], {})), Findings([], {}))
    kept = [path.name for path in tmp_path.iterdir() if not path.name.startswith(".")]
    assert sorted(kept) == ["evidence.json", "stays.jsonl"]


def evidence_of(what: str, out: Path) -> dict[str, dict[str, object]]:
    words = [what, "--out", str(out), "--quiet"]
    assert run("python -m experiments testing", testing.STUDY, testing.__name__, words) == 0
    rows = Evidence.read(out / FILE).tables[what]
    return {str(next(iter(row.values()))): dict(row) for row in rows}


@pytest.fixture
def hashed(monkeypatch) -> None:
    """The sources of these tests, which take long to read."""
    for module in (store, evidence):
        monkeypatch.setattr(module, "sources", lambda *_, **__: "0" * 64)


@pytest.mark.usefixtures("hashed")
def test_counts_of_all_seeds_are_added_and_a_stopped_run_goes_on(tmp_path, monkeypatch):
    ran: list[int] = []

    def pytest_run(*words: str, profile: str) -> str:
        assert profile == "nightly"
        seed = next(int(w.rpartition("=")[2]) for w in words if "seed=" in w)
        ran.append(seed)
        if ran == [1, 2]:
            raise KeyboardInterrupt
        path = next(Path(w.rpartition("=")[2]) for w in words if "--reliability=" in w)
        reliability.write(path, reliability.Counter({reliability.SOLVED: 10 * seed}))
        return ""

    monkeypatch.setattr(testing, "SEEDS", (1, 2))
    monkeypatch.setattr(testing, "_pytest", pytest_run)
    with pytest.raises(AssertionError):
        evidence_of("reliability", tmp_path)
    row = evidence_of("reliability", tmp_path)[reliability.SOLVED]
    assert row["seed_2"] == 20
    assert row["all"] == 30
    assert ran == [1, 2, 2]


@pytest.mark.usefixtures("hashed")
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
