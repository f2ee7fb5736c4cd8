"""The comparison's figures show what its rows say."""

from __future__ import annotations

from pathlib import Path

import pytest

from paper_figs.__main__ import main
from paper_figs.inputs import Row
from paper_figs.studies import solver_comparison


def row(group: str, method: str, dv: float, status: str = "converged", **other: str) -> Row:
    formulation, algorithm, solver = method.split("/")
    return {
        "group": group,
        "scenario": "recon_b",
        "start": "cold",
        "method": method,
        "formulation": formulation,
        "algorithm": algorithm,
        "solver": solver,
        "status": status,
        "problem": "P2",
        "total_dv_m_s": str(dv),
        "cpu_s": "0.5",
        "first_status": "",
        **other,
    }


OURS, THEIRS = "condensed/scvx/CLARABEL", "tuned/hard/IPOPT"
GUESSES = [
    *(row("guesses", OURS, 0.14) for _ in range(2)),
    row("guesses", OURS, 0.14, first_status="infeasible"),
    row("guesses", OURS, 0.26, "infeasible"),
    row("guesses", THEIRS, 0.15),
    row("guesses", THEIRS, float("nan"), "failed"),
]


def test_shares_of_solved_guesses_and_of_those_at_the_best() -> None:
    left, right = solver_comparison.draw_guesses(GUESSES).axes
    assert [label.get_text() for label in left.get_yticklabels()] == [THEIRS, OURS]
    shares = [line.get_xdata()[0] for line in left.lines if line.get_marker() == "o"]
    assert shares == pytest.approx([0.5, 0.5, 0.75, 0.5])  # each time over at the first try
    assert [text.get_text() for text in right.texts] == [
        "0 of 2 at the best",
        "3 of 4 at the best",
    ]


def test_what_was_not_solved_is_hollow() -> None:
    rows = [row("matrix", OURS, 0.14), row("matrix", THEIRS, 0.2, "failed")]
    axes = solver_comparison.draw_times(rows).axes[0]
    points = [line for line in axes.lines if len(line.get_xdata())]
    assert [line.get_markerfacecolor() != "none" for line in points] == [True, False]


def test_profiles_rise_to_the_share_that_is_solved() -> None:
    rows = [
        row("scenarios", OURS, 0.14, cpu_s="0.1"),
        row("scenarios", THEIRS, 0.14, cpu_s="1.0"),
        row("scenarios", OURS, 0.2, scenario="bold"),
        row("scenarios", THEIRS, 0.3, scenario="bold"),
    ]
    ours, theirs = solver_comparison.draw_profiles(rows).axes[0].lines
    assert list(ours.get_xdata()) == [1.0, 1.0]
    assert list(ours.get_ydata()) == [0.5, 1.0]
    assert list(theirs.get_xdata()) == pytest.approx([10.0])
    assert list(theirs.get_ydata()) == [0.5]


def test_a_missing_table_is_told(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["solver_comparison", "--runs", str(tmp_path), "--out", str(tmp_path)]) == 2
    assert "comparison.csv" in capsys.readouterr().err
