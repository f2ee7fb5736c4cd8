"""--json, --quiet and pipes: what every command says, where it says it, and how wide."""

import json
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from scp_recon import __main__ as every
from scp_recon.cli.command import DOCUMENT
from scp_recon.cli.commands import export
from scp_recon.results.read import read_solution

pytestmark = pytest.mark.slow

STATE = "-122.618 419.945 -556.206 0.0069457 0.0794873 0.0655264"
"""Near the default plan at 17,000 s, J2000."""
NEW = ("--body", "Bennu", "--site", "55.9,41.8", "--epoch", "2020-01-21T20:33:17")


@pytest.fixture(scope="module")
def folder(default_run, tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("output")
    read_solution(default_run.folder).write(folder)
    return folder


def words_of(command: str, folder: Path, out: Path) -> list[str]:
    """Arguments with which a command ends well, and soon."""
    plan, study = str(folder), out / "study.toml"
    study.write_text('[[axis]]\nentry = "risk.p_chance"\nvalues = [0.6]\n', "utf-8")
    return {
        "solve": ["--problem", "P3", "--out", str(out / "p3")],
        "verify": [plan],
        "montecarlo": [plan, "--samples", "50"],
        "replan": [plan, "--at", "17000", "--state", STATE, "--out", str(out / "again")],
        "compare": [plan, plan],
        "report": [plan, "--out", str(out / "report.html")],
        "export": [plan, "--format", "csv", "--out", str(out)],
        "new": [str(out / "mission"), *NEW],
        "windows": ["recon_b", "--csv", str(out / "windows.csv")],
        "scenarios": [],
        "schema": [str(out / "schema.json")],
        "campaign": [str(study), "--workers", "0", "--out", str(out / "campaign")],
    }[command]


RUN = sorted(every.COMMANDS.keys() - {"simulate", "design", "explore"})
"""All but those that take long, or serve until they are stopped."""


@pytest.mark.parametrize("command", RUN)
def test_json_is_one_document_and_quiet_silent(command, folder, tmp_path, capsys):
    words = words_of(command, folder, tmp_path)
    status = every.main([command, *words, "--json", "--quiet"])
    said = capsys.readouterr()
    document = json.loads(said.out)
    assert said.out.count("\n") == 1
    assert said.err == ""
    assert (document["schema"], document["command"]) == (DOCUMENT, command)
    assert document["status"] == status
    assert status == 0 or (command, status) == ("montecarlo", 4)  # of so few flights
    assert all(Path(file).is_file() for file in document.get("files", ()))


@pytest.mark.parametrize(
    ("module", "words", "extra"),
    [
        ("Basilisk", "simulate PLAN", "sim"),
        ("spiceypy", "export PLAN --format spk", "spice"),
        ("spiceypy", "export PLAN --format ck", "spice"),
        ("pyarrow", "export PLAN --format parquet", ""),
        ("matplotlib", "windows recon_b --chart w.png", "report"),
        ("jinja2", "solve --report", "report"),
    ],
)
def test_missing_extra_is_named_before_any_work(
    module, words, extra, folder, tmp_path, monkeypatch, capsys
):
    monkeypatch.chdir(tmp_path)
    for name in [name for name in sys.modules if module.lower() in name.lower()]:
        monkeypatch.delitem(sys.modules, name)
    monkeypatch.delitem(sys.modules, "scp_recon.reports.pictures", raising=False)
    monkeypatch.setitem(sys.modules, module, None)
    before = sorted(folder.rglob("*"))
    assert every.main(words.replace("PLAN", str(folder)).split()) == 2
    assert f"scp_recon[{extra}" in capsys.readouterr().err
    assert sorted(folder.rglob("*")) == before
    assert not list(tmp_path.iterdir())


def test_json_has_exact_figures_and_text_the_frame(folder, capsys):
    assert every.main(["verify", str(folder), "--json"]) == 0
    said = capsys.readouterr()
    document, solution = json.loads(said.out), read_solution(folder)
    assert document["frame"] == "J2000, body-centred"
    burns = np.array([burn["dv_m_s"] for burn in document["plan"]["burns"]])
    np.testing.assert_array_equal(burns, solution.burns_m_s)
    assert document["plan_hash"] == solution.plan_hash
    assert document["plan"]["verification"]["ok"] is True
    epoch = "times from 2020-01-21T20:33:17.184 TDB, 2020-01-21T20:32:07.999 UTC"
    assert f"x, y, z along J2000; {epoch}" in said.err


def test_screen_of_a_plan_is_short(folder, monkeypatch, capsys):
    """The default plan in 30 lines of 100 columns, of which solve's path takes one; rows fit in 80."""
    said = {}
    for columns, more in ((100, []), (80, []), (100, ["-v"])):
        monkeypatch.setenv("COLUMNS", str(columns))
        assert every.main(["verify", str(folder), *more]) == 0
        said[columns, *more] = capsys.readouterr().out.splitlines()
    assert sum(max(1, -(-len(line) // 100)) for line in said[100,]) <= 29
    rows = {line.split()[0]: line for line in said[100,] if line}
    plan = read_solution(folder)
    words = {line.split()[0] for line in said[80,] if line}
    assert {"dv_max", "dv_battery", "safety_radius", "phase", "battery_observation"} <= words
    worst = {m.name: np.rad2deg(m.worst_margin) for m in plan.verification.mean_margins}
    low, high = (float(rows["emission"].split()[i]) for i in (5, 7))
    assert low == pytest.approx(20.0 + worst["emission_min"], rel=1e-3)
    assert high == pytest.approx(45.0 - worst["emission_max"], rel=1e-3)
    assert rows["site_distance"].endswith("max binds")
    assert not any(line.startswith("re-integrated") for line in said[100,])
    assert any(line.startswith("re-integrated") for line in said[100, "-v"])


def test_help_and_unknown_commands_list_all_commands(capsys):
    for words in ([], ["fly"], ["--verse"]):
        assert every.main(words) == 2
        assert "solve" in capsys.readouterr().err
    assert every.main(["--version"]) == 0
    assert capsys.readouterr().out == f"scp-recon {every.version_of('scp_recon')}\n"
    assert every.main(["--help"]) == 0
    said = capsys.readouterr().out
    assert all(f"  {command} " in said for command in every.COMMANDS)
    for command in every.COMMANDS:
        with pytest.raises(SystemExit) as end:
            every.main([command, "--help"])
        assert end.value.code == 0


def test_exported_plans_and_spacecraft_never_share_a_name(folder, tmp_path, capsys):
    """And one that is not verified says so in its file."""
    solution = read_solution(folder)
    first, *others = solution.burns
    moved = replace(first, dv_m_s=tuple(x * (1.0 + 1e-12) for x in first.dv_m_s))
    other, out = tmp_path / "other", tmp_path / "out"
    other.mkdir()
    replace(solution, burns=[moved, *others], verification=None).write(other)
    given = ([str(folder)], 0), ([str(other)], 4), ([str(folder), "--spacecraft=-64"], 0)
    for words, status in given:
        form = ["--format", "csv", "--out", str(out), "--quiet"]
        assert export.main([*words, *form]) == status
    texts = [path.read_text("utf-8") for path in out.iterdir()]
    assert len(texts) == 3
    assert sum("# NOT VERIFIED" in text for text in texts) == 1
    assert capsys.readouterr().out == ""
    assert export.main([str(folder), "--format", "csv", "--json"]) == 0
    document = json.loads(capsys.readouterr().out)
    assert document["linear_error_m"] <= document["asked_error_m"] == pytest.approx(0.01)
    assert all(solution.plan_hash[:8] in Path(file).name for file in document["files"])
    assert all(Path(file).parent == folder / "export" for file in document["files"])
