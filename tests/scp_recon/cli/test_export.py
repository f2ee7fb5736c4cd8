"""`python -m scp_recon export`: every format, what it says, and what it refuses."""

from __future__ import annotations

import json
import shutil
import sys
from dataclasses import replace
from pathlib import Path

import pytest

from scp_recon.cli.commands import export
from scp_recon.interop.files import FORMATS
from scp_recon.results.read import read_solution
from tests.scp_recon.support import CommandLine


@pytest.fixture(scope="module")
def plan(default_run: CommandLine, tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("plan")
    shutil.copy(default_run.folder / "solution.json", folder)
    return folder


@pytest.mark.parametrize("form", FORMATS)
def test_every_format_is_written_beside_the_plan(
    plan: Path, form: str, capsys: pytest.CaptureFixture[str]
) -> None:
    if form in ("spk", "ck"):
        pytest.importorskip("spiceypy")
    if form == "parquet":
        pytest.importorskip("pyarrow")
    assert export.main([str(plan), "--format", form, "--json"]) == 0
    said = capsys.readouterr()
    document = json.loads(said.out)
    assert document["status"] == 0
    assert document["linear_error_m"] <= document["asked_error_m"] == 0.01
    assert all(Path(file).parent == plan / "export" for file in document["files"])
    assert all(Path(file).stat().st_size > 500 for file in document["files"])
    assert "verified" in said.err
    names = " ".join(document["files"])
    assert read_solution(plan).plan_hash[:8] in names


def test_two_plans_and_two_spacecraft_never_share_a_name(
    plan: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    solution = read_solution(plan)
    burns = [
        replace(burn, dv_m_s=tuple(x * (1.0 + 1e-12) for x in burn.dv_m_s))
        for burn in solution.burns
    ]
    other = tmp_path / "other"
    other.mkdir()
    replace(solution, burns=burns).write(other)
    out = tmp_path / "out"
    for words in ([str(plan)], [str(other)], [str(plan), "--spacecraft=-64"]):
        assert export.main([*words, "--format", "csv", "--out", str(out), "--quiet"]) in (0, 4)
    assert len(list(out.iterdir())) == 3
    assert capsys.readouterr().out == ""


def test_a_plan_that_is_not_verified_is_written_and_says_so(
    plan: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    replace(read_solution(plan), verification=None).write(tmp_path)
    assert export.main([str(tmp_path), "--format", "csv", "--json"]) == 4
    said = capsys.readouterr()
    document = json.loads(said.out)
    assert document["verdict"].startswith("NOT VERIFIED")
    (file,) = document["files"]
    assert "# NOT VERIFIED" in Path(file).read_text("utf-8")
    assert "not verified: converged, and never checked\n" in said.err


@pytest.mark.parametrize(
    ("words", "expected"),
    [
        (["--format", "xls"], "--format: got 'xls'; must be one of oem"),
        ([], "--format"),
        (["--format", "csv", "--spacecraft=64"], "must be a whole number from -99999 to -1"),
        (["--format", "csv", "--spacecraft=-0"], "whole number"),
        (["--format", "csv", "--spacecraft=-123456789"], "whole number"),
        (["--format", "csv", "--vehicle", "nothing.toml"], "vehicle"),
        (["--format", "csv", "--out", "solution.json"], "--out"),
    ],
)
def test_bad_input_ends_in_one_message(
    plan: Path,
    words: list[str],
    expected: str,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.chdir(plan)
    try:
        status = export.main([str(plan), *words, "--json"])
    except SystemExit as end:  # argparse ends this way
        status = int(end.code or 0)
    said = capsys.readouterr()
    assert status == 2
    assert expected in said.err
    document = json.loads(said.out)
    assert (document["command"], document["status"]) == ("export", 2)
    assert expected in document["error"]["message"]


@pytest.mark.parametrize(
    ("form", "module"), [("spk", "spiceypy"), ("ck", "spiceypy"), ("parquet", "pyarrow")]
)
def test_an_extra_that_is_missing_is_named(
    plan: Path,
    form: str,
    module: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.setitem(sys.modules, module, None)
    out = tmp_path / "out"
    assert export.main([str(plan), "--format", form, "--out", str(out)]) == 2
    assert "scp_recon[" in capsys.readouterr().err
    assert not out.exists()
