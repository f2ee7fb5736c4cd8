"""`python -m scp_recon design`: what it leaves on disk, and what it says where nothing is found."""

import csv
from contextlib import nullcontext
from io import StringIO
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from rich.console import Console

from scp_recon.cli import plan_run
from scp_recon.cli.commands import design, solve
from scp_recon.cli.plan_run import primer_says
from scp_recon.mission.mission import Mission
from scp_recon.planning.primer import PrimerHistory
from scp_recon.results.read import read_solution
from scp_recon.scenario.load import load_scenario, scenario_text
from tests.scp_recon.passes.support import home_scenario

pytestmark = pytest.mark.slow


def scenario_file(folder: Path, changes: dict[str, object]) -> Path:
    path = folder / "home.toml"
    path.write_text(scenario_text(home_scenario(changes)), "utf-8")
    return path


NARROW = {
    "boundary.home.departure_deg": [140.0, 175.0],
    "boundary.home.arrival_deg": [-20.0, 15.0],
    "grid.step_max_s": 464.0,
}


def test_design_writes_verified_plan_scenario_and_table(tmp_path, monkeypatch, capsys):
    monkeypatch.setenv("COLUMNS", "300")
    out = tmp_path / "out"
    monkeypatch.setattr(plan_run, "saving", lambda *_: ("next: cheaper, with: --set a=1",))
    assert design.main([str(scenario_file(tmp_path, NARROW)), "--out", str(out)]) == 0
    solution = read_solution(out)
    advice = "these options are for solve --scenario " + str(out / "scenario.toml")
    assert advice in capsys.readouterr().out
    assert solution.verification.ok
    assert solution.total_dv_m_s <= 0.0254
    # The scenario stands for itself, and a plan of it from cold is no cheaper.
    fixed = load_scenario(out / "scenario.toml")
    assert fixed == solution.scenario
    Mission.from_scenario(fixed)
    again = tmp_path / "again"
    assert solve.main(["--scenario", str(out / "scenario.toml"), "--out", str(again)]) == 0
    assert read_solution(again).total_dv_m_s == pytest.approx(solution.total_dv_m_s, rel=2e-3)
    with (out / "design.csv").open() as file:
        rows = list(csv.DictReader(file))
    for row in rows:
        assert np.diff(list(map(float, row["times_s"].split()))).min() > 0.0
    steps = {row["step"] for row in rows}
    assert steps == {"map", "descent", "refinement", "fewer", "number"}
    sizes = np.linalg.norm([burn.dv_m_s for burn in solution.burns], axis=1)
    assert len(sizes) == 3  # the second of the four given vanishes
    assert sizes.min() > 1e-4
    least = min(float(row["dv_m_s"]) for row in rows if row["dv_m_s"] and row["problem"] == "P2")
    assert least == pytest.approx(solution.total_dv_m_s, rel=1e-2)
    for picture in ("design.png", "primer.png"):
        assert (out / picture).read_bytes().startswith(b"\x89PNG")
    assert solution.primer.residual < 1e-3


def test_design_without_pass_names_limit_and_departure(tmp_path, capsys, monkeypatch):
    monkeypatch.setenv("COLUMNS", "300")
    changes = NARROW | {"burns.dv_max_m_s": 0.001, "boundary.home.arrival_deg": [0.0, 0.0]}
    out = tmp_path / "out"
    assert design.main([str(scenario_file(tmp_path, changes)), "--out", str(out)]) == 3
    said = capsys.readouterr().out
    assert "no pass found" in said
    assert "was stopped by" in said
    assert ", short by" in said
    assert "from 1" in said  # a departure between 140 and 175 deg
    assert not (out / "solution.json").exists()
    assert (out / "design.csv").exists()


@pytest.mark.parametrize(
    ("allowed", "legal", "residual", "says"),
    [
        (0.9, True, 1e-4, "no additional small burn helps"),
        (1.2, True, 1e-4, "an additional burn at 60 s would help"),
        (1.2, False, 1e-4, "no time is legal"),
        (0.9, True, 0.75, "a residual of 0.75, at most 0.1 expected: no conclusion"),
    ],
)
def test_primer_concludes_only_from_small_residuals(allowed, legal, residual, says):
    """Those of plans with gains may be far from an optimum's."""
    ends = [(0.0, 0.0, 0.0)] * 3
    history = PrimerHistory(
        [0.0, 60.0, 120.0], ends, [1.0, allowed, 1.0], [False, legal, False], residual
    )
    assert says in primer_says(history)


def test_what_is_left_is_shown_in_every_step(monkeypatch):
    """Of a map by its plans; of what follows by the time that the map took."""
    shown, clock = list[str](), [0.0]
    monkeypatch.setattr(plan_run, "monotonic", lambda: clock[0])
    console = Console(file=StringIO())
    status = SimpleNamespace(update=shown.append)
    monkeypatch.setattr(console, "status", lambda _: nullcontext(status))
    result = SimpleNamespace(converged=False, dv_m_s=1.0, space=SimpleNamespace(number=0))
    with plan_run.design_progress(console) as count:
        for time_s, step, expected in ((10.0, "map", 2), (20.0, "map", 2), (30.0, "descent", None)):
            clock[0] = time_s
            count(SimpleNamespace(step=step, expected=expected, result=result))
        clock[0] = 500.0
        count(SimpleNamespace(step="exact", expected=None, result=result))
    assert "of 2, about 10 s left" in shown[0]
    assert shown[2].endswith("; about 50 s left, then its plan")
    assert "left" not in shown[3]
