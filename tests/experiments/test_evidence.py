"""Evidence: what its hash counts, when it is out of date, what a study leaves, how it is renewed."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from experiments import battery_cones, evidence, pages, renewal
from experiments.__main__ import STUDIES, main
from experiments.evidence import SOURCES, UNKNOWN, Evidence, Source, out_of_date, path_of
from experiments.harness import Findings, Record, Session, Study, run
from scp_recon.errors import InputError
from scp_recon.jobs import store
from scp_recon.jobs.job import Job
from scp_recon.results.table import Table

QUICK = Source("experiments battery_cones --samples 100", (battery_cones.__name__,))


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Where evidence goes, of one quick study, and one page."""
    page = tmp_path / "page.md"
    page.write_text(
        "<!--= {cones.battery_cones[observation 90 False].load_w:.0f} -->1<!--/--> W\n", "utf-8"
    )
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
        ("experiments/harness.py", False),
    ],
)
def test_the_hash_counts_scenarios_and_what_is_below_api(
    changed: str, counts: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    def digest() -> str:
        names = (*SOURCES["frontier"].modules, *evidence.DATA)
        return store.sources.__wrapped__(*names, without=evidence.ABOVE)

    before, read = digest(), Path.read_bytes

    def edited(path: Path) -> bytes:
        return read(path) + b"\n#" * (path == evidence.ROOT / changed)

    monkeypatch.setattr(Path, "read_bytes", edited)
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
def test_what_has_changed_is_told(changes: Mapping[str, str], why: str | None) -> None:
    assert out_of_date() == {"cones": "never measured"}
    path_of("cones").parent.mkdir()
    found = begun()
    found = replace(found, **{**changes, **_versions(found, changes)})
    assert Evidence.read(found.write(path_of("cones"))) == found
    said = out_of_date()
    assert (why is None) == (said == {})
    assert why is None or why in said["cones"]


def _versions(found: Evidence, changes: Mapping[str, object]) -> dict[str, object]:
    given = changes.get("versions")
    return {"versions": {**found.versions, **given}} if isinstance(given, dict) else {}


def test_every_command_exists_and_every_file_has_its_command() -> None:
    for source in SOURCES.values():
        first, *words = source.command.split()
        if first == "experiments":
            assert words[0] in STUDIES
        for module in (*([] if first == "experiments" else [first]), *source.modules):
            assert evidence.ROOT.joinpath(*module.split(".")).with_suffix(".py").exists() or (
                evidence.ROOT.joinpath(*module.split(".")).is_dir()
            )
    assert {path.stem for path in evidence.FOLDER.glob("*.json")} == set(SOURCES)


def test_a_study_leaves_its_tables_with_their_origin(tmp_path: Path) -> None:
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
    assert found[0].command == "experiments some"
    assert found[0].sources == found[1].sources != UNKNOWN


def test_what_is_out_of_date_is_renewed_and_only_that(
    folder: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
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
    assert "-->90<!--" in (folder / "page.md").read_text("utf-8")
    assert main(["evidence", "--check"]) == 0
    assert main(["evidence"]) == 0
    assert "up to date" in capsys.readouterr().out


@pytest.mark.usefixtures("folder")
def test_a_study_that_fails_is_named_and_does_not_stop_the_others(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    failing = {"none": QUICK._replace(command="experiments none")}
    monkeypatch.setattr(evidence, "SOURCES", failing | {"cones": QUICK})
    assert main(["evidence"]) == 2
    assert "none: python -m experiments none --out" in capsys.readouterr().out
    assert out_of_date() == {"none": "never measured"}
