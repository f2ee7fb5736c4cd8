"""The table orders as the paper's does, takes up what is there, and says what it does not have."""

from __future__ import annotations

import json
import math
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import pytest

from experiments.__main__ import main
from experiments.harness import Findings, records
from experiments.harness import report as as_markdown
from experiments.observation_table import study as observation_table
from experiments.observation_table.rows import PRINTED_WINDOW_S, rows
from experiments.observation_table.runs import Failed, Measured, run_row
from experiments.observation_table.study import claims, measure, record, report
from scp_recon.mission.mission import Mission
from scp_recon.results.read import read_solution
from scp_recon.results.solution import Solution

from .support import QUICK, SAMPLES, table_of


def study(*words: str) -> int:
    """The command."""
    return main(["observation_table", *words])


KEYS = ("ballistic", "p3", "scp_warm", "scp_cold")


@pytest.fixture(scope="module")
def measured(mission: Mission, finished: tuple[Path, str]) -> list[Measured | Failed]:
    return [
        run_row(row, mission, finished[0] / row.key, samples=SAMPLES, check=False)
        for row in rows(ipopt=False)
    ]


# --- the table ----------------------------------------------------------------------------------


def test_every_row_has_a_solution_and_a_report(finished: tuple[Path, str]) -> None:
    out, printed = finished
    assert tuple(table_of(out)) == KEYS
    for key in KEYS:
        assert read_solution(out / key).problem in ("P3", "P2")
        assert (out / key / "montecarlo.json").exists()
        assert sum(line.startswith(key) for line in printed.splitlines()) == 1


def test_planned_rows_lie_above_the_osiris_rex_rows_in_mean_and_worst_one_sigma(
    finished: tuple[Path, str], measured: list[Measured | Failed]
) -> None:
    table = table_of(finished[0])
    for column in ("mean_s", "worst_1_sigma_s"):
        value = {key: float(row[column]) for key, row in table.items()}
        for planned in ("scp_warm", "scp_cold"):
            assert value[planned] > max(value["ballistic"], value["p3"])
    assert [claim.holds for claim in claims(measured)] == [True, True, True]


def test_cold_start_has_the_full_window_at_worst_one_sigma(finished: tuple[Path, str]) -> None:
    row = table_of(finished[0])["scp_cold"]
    assert row["full_window_at_worst_1_sigma"] == "true"
    assert float(row["worst_1_sigma_s"]) == pytest.approx(float(row["window_s"]), abs=0.5)


def test_without_uncertainty_every_row_observes_throughout(finished: tuple[Path, str]) -> None:
    for row in table_of(finished[0]).values():
        assert float(row["without_uncertainty_s"]) == pytest.approx(PRINTED_WINDOW_S, abs=1.0)


def test_values_lie_in_their_intervals(finished: tuple[Path, str]) -> None:
    for row in table_of(finished[0]).values():
        for name in (
            "mean_s",
            "worst_1_sigma_s",
            "closest_0_3_percent_m",
            "lowest_joint_probability",
            "lowest_probability_all_at_once",
        ):
            low, value, high = (float(row[f"{name}{end}"]) for end in ("_low", "", "_high"))
            assert low <= value <= high


def test_counting_on_a_coarse_grid_comes_near_the_exact_mean(finished: tuple[Path, str]) -> None:
    """Fifteen nodes of the window: a flight is off by a node or two at each end."""
    for row in table_of(finished[0]).values():
        assert float(row["mean_on_uniform_grid_s"]) == pytest.approx(float(row["mean_s"]), abs=60.0)


def test_report_names_surrogates_and_what_is_not_reproduced(finished: tuple[Path, str]) -> None:
    text = (finished[0] / "observation_table.md").read_text("utf-8")
    for words in ("surrogate", "2930", "2785", "3043", "3017", "3271", "667.24", "| no |"):
        assert words in text
    assert "kernel was not at hand" in text


# --- taking up ----------------------------------------------------------------------------------


def test_a_rerun_takes_up_what_is_complete(copy: Path, capsys: pytest.CaptureFixture[str]) -> None:
    before = {path: path.stat().st_mtime_ns for path in copy.rglob("*.json")}
    table = (copy / "observation_table.csv").read_text("utf-8")
    assert study(*QUICK, "--out", str(copy)) == 0
    assert capsys.readouterr().out.count("taken up") == len(KEYS)
    assert {path: path.stat().st_mtime_ns for path in copy.rglob("*.json")} == before
    assert (copy / "observation_table.csv").read_text("utf-8") == table


def test_damaged_rows_alone_are_computed_again(
    copy: Path, mission: Mission, finished: tuple[Path, str]
) -> None:
    (copy / "ballistic" / "montecarlo.json").write_text('{"schema": 1}', encoding="utf-8")
    (copy / "p3" / "solution.json").unlink()
    entries = measure(
        mission,
        rows(ipopt=False),
        copy,
        samples=SAMPLES,
        check=False,
        fresh=False,
        tell=lambda _: None,
    )
    reused = {e.row.key: e.reused for e in entries if isinstance(e, Measured)}
    assert reused == {"ballistic": False, "p3": False, "scp_warm": True, "scp_cold": True}
    assert records([record(e) for e in entries]).csv() == (
        finished[0] / "observation_table.csv"
    ).read_text("utf-8")


@pytest.mark.parametrize("age", ["of another plan", "older"])
def test_flights_of_another_plan_are_flown_again(copy: Path, mission: Mission, age: str) -> None:
    """And the table is that of the plan that is there."""
    row = next(r for r in rows(ipopt=False) if r.key == "p3")
    file = copy / row.key / "montecarlo.json"
    before = file.read_bytes()
    data = json.loads(before)
    if age == "older":
        del data["plan_hash"]
    else:
        other = json.loads((copy / "ballistic" / "montecarlo.json").read_text("utf-8"))
        data = {**other, "planned_dv_m_s": data["planned_dv_m_s"]}
    file.write_text(json.dumps(data), "utf-8")
    entry = run_row(row, mission, copy / row.key, samples=SAMPLES, check=False)
    assert not entry.reused
    assert entry.summary.is_of(read_solution(copy / row.key))
    assert file.read_bytes() == before


def test_a_plan_that_differs_by_a_bit_is_flown_again(copy: Path, mission: Mission) -> None:
    row = next(r for r in rows(ipopt=False) if r.key == "p3")
    solution = read_solution(copy / row.key)
    burn = solution.burns[1]
    x, y, z = burn.dv_m_s
    moved = replace(burn, dv_m_s=(math.nextafter(x, 0.0), y, z))
    burns = [solution.burns[0], moved, *solution.burns[2:]]
    replace(solution, burns=burns).write(copy / row.key)
    entry = run_row(row, mission, copy / row.key, samples=SAMPLES, check=False)
    assert not entry.reused
    assert entry.summary.plan_hash != solution.plan_hash


def test_other_sample_counts_keep_the_design_and_fly_again(copy: Path, mission: Mission) -> None:
    row = rows(ipopt=False)[0]
    written = (copy / row.key / "solution.json").stat().st_mtime_ns
    entry = run_row(row, mission, copy / row.key, samples=100, check=False)
    assert not entry.reused
    assert entry.summary.samples == 100
    assert (copy / row.key / "solution.json").stat().st_mtime_ns == written


def test_a_plan_is_verified_when_that_is_asked(copy: Path, mission: Mission) -> None:
    row = next(r for r in rows(ipopt=False) if r.key == "p3")
    assert read_solution(copy / row.key).verification is None
    entry = run_row(row, mission, copy / row.key, samples=SAMPLES, check=True)
    assert entry.status == "P3 converged, verified"


# --- failure ------------------------------------------------------------------------------------


def failing(_: Mission) -> Solution:
    raise RuntimeError("the solver\nlost its way")


def test_a_failed_row_says_so_and_the_others_run(
    copy: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    first, *others = rows(ipopt=False)
    broken = (replace(first, key="broken", design=failing), *others)
    monkeypatch.setattr(observation_table, "rows", lambda **_: broken)
    assert study(*QUICK, "--out", str(copy)) == 4
    assert "broken       failed: RuntimeError: the solver lost its way" in capsys.readouterr().out
    table = table_of(copy)
    assert table["broken"]["status"].startswith("failed")
    assert table["broken"]["mean_s"] == ""
    assert float(table["scp_cold"]["mean_s"]) > 0.0
    assert "not computed" in (copy / "observation_table.md").read_text("utf-8")


def test_a_row_that_fails_afresh_leaves_no_old_result(copy: Path, mission: Mission) -> None:
    row = replace(rows(ipopt=False)[0], design=failing)
    with pytest.raises(RuntimeError):
        run_row(row, mission, copy / row.key, samples=SAMPLES, check=False, fresh=True)
    assert list((copy / row.key).iterdir()) == []


def test_a_table_of_failures_is_still_a_table() -> None:
    entries = [Failed(row, "nothing works") for row in rows()]
    lost = records([record(entry) for entry in entries]).csv()
    assert lost.count("failed: nothing works") == len(entries)
    text = as_markdown("", Findings(report(entries), {}))
    assert text.count("failed: nothing works") == len(entries)
    assert claims(entries) == []


@pytest.mark.parametrize("arguments", [["--samples", "1"], ["--samples", "x"], ["--unknown"]])
def test_bad_options_exit_with_two(arguments: list[str]) -> None:
    with pytest.raises(SystemExit) as stop:
        study(*arguments)
    assert stop.value.code == 2


def test_a_folder_that_cannot_be_written_exits_with_two(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "file").write_text("", encoding="utf-8")
    assert study(*QUICK, "--out", str(tmp_path / "file")) == 2
    assert "must be writable" in capsys.readouterr().err


def test_the_reference_solver_is_imported_only_where_it_is_used() -> None:
    code = (
        "import sys, experiments.observation_table.study; "
        "from experiments.observation_table.rows import rows; "
        "print(len(rows()), len(rows(ipopt=False)), {'casadi', 'spiceypy'} & set(sys.modules))"
    )
    run = subprocess.run(
        [sys.executable, "-W", "error", "-c", code],
        cwd=Path(__file__).parents[2],
        capture_output=True,
        text=True,
        timeout=60,
        check=True,
    )
    assert run.stdout.strip() == "6 4 set()"
