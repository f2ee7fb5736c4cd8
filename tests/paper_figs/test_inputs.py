"""Studies are run where they have left nothing, each once, with the plan in its place."""

from __future__ import annotations

import sys
from pathlib import Path

from paper_figs.inputs import PLAN, TABLE, run_missing
from paper_figs.registry import STUDIES

WANTED = [item.source for item in STUDIES.values()]


def test_what_is_missing_is_run_once_and_what_is_there_is_left_alone(tmp_path: Path) -> None:
    there = STUDIES["frontier"].source.folder
    (tmp_path / there).mkdir()
    ran: list[list[str]] = []
    said: list[str] = []

    def run(words: list[str]) -> int:
        ran.append(words)
        return 2 if "simulate" in words else 0

    runs = tmp_path / "paper"
    run_missing(runs, tmp_path, WANTED, said.append, run)
    assert ran[0] == [sys.executable, "-m", "experiments", "observation_table", "--out", str(runs)]
    places = [words[-1] for words in ran[1:]]
    folders = {source.folder for source in WANTED} - {there}
    assert sorted(places) == sorted(str(tmp_path / folder) for folder in folders)
    assert all("SOLUTION" not in words for words in ran)
    simulated = next(words for words in ran if "simulate" in words)
    assert simulated[4] == str(runs / PLAN)
    assert said.count("exit status 2: left out") == 1


def test_of_a_plan_of_one_s_own_no_table_is_made(tmp_path: Path) -> None:
    (tmp_path / "solution.json").write_text("{}", "utf-8")
    ran: list[list[str]] = []
    run_missing(
        tmp_path, tmp_path / "studies", WANTED, lambda _: None, lambda w: ran.append(w) or 0
    )
    assert not [words for words in ran if "observation_table" in words]
    assert str(tmp_path) in next(words for words in ran if "simulate" in words)
    (tmp_path / "paper").mkdir()
    (tmp_path / "paper" / TABLE).touch()
    run_missing(tmp_path / "paper", tmp_path, [], lambda _: None, lambda w: ran.append(w) or 0)
    assert not [words for words in ran if "observation_table" in words]
