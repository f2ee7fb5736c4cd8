"""--json, --quiet and pipes: what every command says, where it says it, and how wide."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pytest

from scp_recon import __main__ as every
from scp_recon.cli.command import DOCUMENT, WIDE
from scp_recon.results.comparison import compare
from scp_recon.results.read import read_solution
from tests.scp_recon.support import CommandLine

pytestmark = pytest.mark.usefixtures("few_flights")

PROJECT = Path(__file__).parents[3]
STATE = "-122.618 419.945 -556.206 0.0069457 0.0794873 0.0655264"
"""Near the default plan at 17,000 s, J2000."""
NEW = ("--body", "Bennu", "--site", "20,150", "--epoch", "2020-01-21T20:33:17")


@pytest.fixture(scope="module")
def folder(default_run: CommandLine, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Of a plan."""
    folder = tmp_path_factory.mktemp("output")
    read_solution(default_run.folder).write(folder)
    return folder


def words_of(command: str, folder: Path, out: Path) -> list[str]:
    """Arguments with which a command ends well, and soon."""
    plan = str(folder)
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
        "campaign": [a_study(out), "--workers", "0", "--out", str(out / "campaign")],
    }[command]


def a_study(folder: Path) -> str:
    """Of one plan."""
    path = folder / "study.toml"
    path.write_text('[[axis]]\nentry = "risk.p_chance"\nvalues = [0.6]\n', "utf-8")
    return str(path)


RUN = sorted(every.COMMANDS.keys() - {"simulate", "design"})


@pytest.mark.parametrize("command", RUN)
def test_json_is_one_document_and_quiet_is_silent(
    command: str, folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
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


@pytest.mark.parametrize("command", ["compare", "windows"])
def test_what_people_read_goes_to_standard_error(
    command: str, folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    words = words_of(command, folder, tmp_path)
    assert every.main([command, *words]) == 0
    plain = capsys.readouterr().out
    assert every.main([command, *words, "--json"]) == 0
    said = capsys.readouterr()
    assert said.err == plain != ""
    assert json.loads(said.out)["status"] == 0


@pytest.mark.parametrize("command", sorted({*every.COMMANDS} - {"scenarios"}))  # has no input
def test_bad_input_is_a_document_too(
    command: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    nothing = str(tmp_path / "nothing" / "there")
    words = {
        "solve": ["--scenario", nothing],
        "export": [nothing, "--format", "oem"],
        "replan": [nothing, "--at", "17000", "--state", STATE],
        "new": [nothing, "--body", "Nobody", *NEW[2:]],
        "schema": ["/dev/null/schema.json"],
        "campaign": [nothing, "--out", str(tmp_path / "out")],
    }.get(command, [nothing])
    assert every.main([command, *words, "--json", "--quiet"]) == 2
    said = capsys.readouterr()
    error = json.loads(said.out)["error"]
    assert said.err.strip() == f"error: {error['message']}"
    if "entry" in error:
        assert error["message"] == f"{error['entry']}: got {error['given']}; {error['allowed']}"


@pytest.mark.parametrize("command", sorted(every.COMMANDS))
def test_a_command_line_that_cannot_be_read_is_a_document_too(
    command: str, capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(SystemExit) as end:
        every.main([command, "--no-such-option", "--json"])
    assert end.value.code == 2
    assert json.loads(capsys.readouterr().out)["status"] == 2


def test_json_has_the_plans_figures_to_the_last_digit(
    folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert every.main(["verify", str(folder), "--json", "--quiet"]) == 0
    document = json.loads(capsys.readouterr().out)
    solution = read_solution(folder)
    assert document["frame"] == "J2000, body-centred"
    burns = np.array([burn["dv_m_s"] for burn in document["plan"]["burns"]])
    np.testing.assert_array_equal(burns, solution.burns_m_s)
    assert document["plan_hash"] == solution.plan_hash
    assert document["plan"]["verification"]["ok"] is True


def piped(*words: str, cwd: Path | None = None) -> subprocess.CompletedProcess[str]:
    bare = {key: value for key, value in os.environ.items() if key != "COLUMNS"}
    return subprocess.run(
        [sys.executable, "-m", "scp_recon", *words],
        env=bare | {"PYTHONPATH": str(PROJECT)},
        cwd=cwd,
        capture_output=True,
        text=True,
        timeout=120,
        check=False,
    )


def test_tables_keep_their_lines_in_a_pipe(folder: Path, tmp_path: Path) -> None:
    """A terminal of 80 columns would fold these names."""
    names = ["a_folder_with_a_long_name_" * 2, "another_folder_with_a_long_name"]
    for name in names:
        (tmp_path / name).mkdir()
        read_solution(folder).write(tmp_path / name)
    run = piped("compare", *names, cwd=tmp_path)
    assert run.returncode == 0
    assert run.stderr == ""
    heading, *rows = run.stdout.splitlines()
    assert heading.split() == names
    assert len(rows) == len(compare(["a", "b"], [read_solution(folder)] * 2).rows)
    assert max(map(len, run.stdout.splitlines())) <= WIDE


def test_frame_and_epoch_stand_by_the_burns(
    folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert every.main(["verify", str(folder)]) == 0
    assert (
        "x, y, z along J2000; times from 2020-01-21T20:33:17.184 TDB, 2020-01-21T20:32:07.999 UTC"
        in capsys.readouterr().out
    )


def test_boundary_states_are_told_without_axes(default_run: CommandLine) -> None:
    """In the Sun-North frame X leads to the Sun."""
    boundary = read_solution(default_run.folder).scenario.boundary
    position, velocity = np.array(boundary.initial_position_m), boundary.initial_velocity_m_s
    distance = np.linalg.norm(position)
    off_sun = np.rad2deg(np.arccos(position[0] / distance))
    assert (
        f"boundary  at 0 s {distance:.0f} m from the centre, {off_sun:.1f} deg off the Sun, "
        f"{np.linalg.norm(velocity):.4f} m/s of which {position @ velocity / distance:+.4f} upwards; "
        "at 34842 s 1138 m"
    ) in default_run.output


@pytest.mark.parametrize("words", [[], ["fly"], ["--verse"]])
def test_a_command_that_there_is_not_is_named(
    words: Sequence[str], capsys: pytest.CaptureFixture[str]
) -> None:
    assert every.main(words) == 2
    assert all(command in capsys.readouterr().err for command in ("solve",))


def test_help_names_every_command(capsys: pytest.CaptureFixture[str]) -> None:
    assert every.main(["--help"]) == 0
    said = capsys.readouterr().out
    for command in every.COMMANDS:
        assert f"  {command} " in said
        with pytest.raises(SystemExit) as end:
            every.main([command, "--help"])
        assert end.value.code == 0


def test_the_console_script_is_declared_and_calls_itself_so(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    declared = (PROJECT / "pyproject.toml").read_text("utf-8")
    assert 'scp-recon = "scp_recon.__main__:script"' in declared
    monkeypatch.setattr(sys, "argv", ["/usr/bin/scp-recon", "verify", "--help"])
    with pytest.raises(SystemExit) as end:
        every.main()
    assert end.value.code == 0
    assert capsys.readouterr().out.startswith("usage: scp-recon verify ")
