"""Studies that are stopped go on where they were."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from experiments import frontier, kept
from experiments.kept import Kept
from experiments.timing_rules.__main__ import as_kept, from_kept
from experiments.timing_rules.flights import STEADY_DEG, Slew


def test_a_row_is_made_once(tmp_path: Path) -> None:
    path, made = tmp_path / "runs" / "partial.jsonl", []

    def row(key: str) -> dict[str, Any]:
        made.append(key)
        return {"kind": key, "value": math.nan, "far": math.inf, "holds": True, "third": 1 / 3}

    first = Kept(path, kept.__file__, {"flights": 3})
    rows = [first.row(key, lambda key=key: row(key)) for key in ("a", "b")]
    second = Kept(path, kept.__file__, {"flights": 3})
    again = [second.row(key, lambda key=key: row(key)) for key in ("a", "b", "c")]
    assert made == ["a", "b", "c"]
    assert repr(again[:2]) == repr(rows)
    second.forget()
    assert not path.exists()


@pytest.mark.parametrize("change", ["setting", "sources", "damage", "other"])
def test_rows_of_anything_else_are_left_alone(
    tmp_path: Path, change: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "partial.jsonl"
    Kept(path, kept.__file__, {"flights": 3}).row("a", lambda: {"value": 1.0})
    setting = {"flights": 3}
    if change == "setting":
        setting = {"flights": 4}
    elif change == "sources":
        monkeypatch.setattr(kept, "sources_hash", lambda _: "other")
    elif change == "damage":
        path.write_text(path.read_text("utf-8")[:-5], encoding="utf-8")
    else:
        path.write_text("\n[]\n", encoding="utf-8")
    assert Kept(path, kept.__file__, setting).rows == {}


def test_the_frontier_goes_on_after_ctrl_c(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(frontier, "KINDS", dict(list(frontier.KINDS.items())[:2]))
    planned: list[str] = []

    def made(kind: str, p: float, *_: object) -> dict[str, Any]:
        if len(planned) == 1 and not (tmp_path / "pressed").exists():
            (tmp_path / "pressed").touch()
            raise KeyboardInterrupt
        planned.append(f"{kind} {p:g}")
        figures = ("certified_low", "node", "whole_flight", "observed_mean_s", "seconds")
        return {
            "kind": kind, "asked": p, "status": "converged", "total_dv_m_s": 0.1, "aim": math.nan,
            **dict.fromkeys(figures, 0.5),
        }  # fmt: skip

    monkeypatch.setattr(frontier, "_row", made)
    words = ["--quick", "--out", str(tmp_path)]
    assert frontier.main(words) == 130
    assert (tmp_path / "frontier_partial.jsonl").exists()
    assert frontier.main(words) == 0
    assert len(planned) == len(set(planned)) == 4
    assert not (tmp_path / "frontier_partial.jsonl").exists()
    assert capsys.readouterr().out.count("0.10000 m/s") == 5


def test_a_slew_is_kept_whole() -> None:
    times = (*(10.0 * k for k in range(1, len(STEADY_DEG))), math.inf)
    slew = Slew(np.array([0.6, 0.0, 0.8]), 0.25, times, 1 / 3)
    again = from_kept(as_kept(slew))
    np.testing.assert_array_equal(again.axis, slew.axis)
    assert (again.wheel_share, again.settling_s, again.steady_deg) == (0.25, times, 1 / 3)
