"""`python -m scp_recon export`: every format, what it says, and what it refuses."""

import json
import shutil
from dataclasses import replace
from pathlib import Path

import pytest

from scp_recon.cli.commands import export
from scp_recon.results.read import read_solution

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def plan(default_run, tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("plan")
    shutil.copy(default_run.folder / "solution.json", folder)
    return folder


def test_plans_and_spacecraft_never_share_a_name(plan, tmp_path, capsys):
    """And one that is not verified says so in its file."""
    solution = read_solution(plan)
    first, *others = solution.burns
    moved = replace(first, dv_m_s=tuple(x * (1.0 + 1e-12) for x in first.dv_m_s))
    other, out = tmp_path / "other", tmp_path / "out"
    other.mkdir()
    replace(solution, burns=[moved, *others], verification=None).write(other)
    given = ([str(plan)], 0), ([str(other)], 4), ([str(plan), "--spacecraft=-64"], 0)
    for words, status in given:
        form = ["--format", "csv", "--out", str(out), "--quiet"]
        assert export.main([*words, *form]) == status
    texts = [path.read_text("utf-8") for path in out.iterdir()]
    assert len(texts) == 3
    assert sum("# NOT VERIFIED" in text for text in texts) == 1
    assert capsys.readouterr().out == ""
    assert export.main([str(plan), "--format", "csv", "--json"]) == 0
    document = json.loads(capsys.readouterr().out)
    assert document["linear_error_m"] <= document["asked_error_m"] == pytest.approx(0.01)
    assert all(solution.plan_hash[:8] in Path(file).name for file in document["files"])
    assert all(Path(file).parent == plan / "export" for file in document["files"])
