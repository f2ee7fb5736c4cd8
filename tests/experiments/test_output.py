"""--json and --quiet of the studies."""

from __future__ import annotations

import importlib
import json
from pathlib import Path

import pytest

STUDIES = (
    *("battery_cones", "frontier", "nlp_tricks", "compare_solvers.__main__"),
    *("flown_plan.__main__", "model_fidelity.__main__", "observation_table.__main__"),
    *("timing_rules.__main__", "uncertainty_sources.__main__", "openscvx_peer.__main__"),
)


@pytest.mark.parametrize("study", STUDIES)
def test_a_command_line_that_cannot_be_read_is_a_document(
    study: str, capsys: pytest.CaptureFixture[str]
) -> None:
    module = importlib.import_module(f"experiments.{study}")
    with pytest.raises(SystemExit) as end:
        module.main(["--no-such-option", "--json"])
    assert end.value.code == 2
    document = json.loads(capsys.readouterr().out)
    assert document["command"] == f"experiments.{study.removesuffix('.__main__')}"


def test_a_study_is_one_document_or_silent(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    study = importlib.import_module("experiments.battery_cones")
    words = ["--samples", "100", "--out", str(tmp_path)]
    assert study.main([*words, "--json"]) == 0
    said = capsys.readouterr()
    assert json.loads(said.out)["folder"] == str(tmp_path)
    assert "written: " in said.err
    assert study.main([*words, "--quiet"]) == 0
    assert capsys.readouterr() == ("", "")
    assert any(tmp_path.iterdir())
