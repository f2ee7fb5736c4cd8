"""Studies are run where they have left nothing, each once, with the plan in its place."""

from __future__ import annotations

import sys
from pathlib import Path

from paper_figs.__main__ import STUDIES
from paper_figs.first import run_first
from paper_figs.inputs import PLAN, TABLE

WANTED = [(study.FOLDER, study.COMMAND) for study in STUDIES.values()]


def test_what_is_missing_is_run_once_and_what_is_there_is_left_alone(tmp_path: Path) -> None:
    there = STUDIES["frontier"].FOLDER
    (tmp_path / there).mkdir()
    ran: list[list[str]] = []
    said: list[str] = []

    def run(words: list[str]) -> int:
        ran.append(words)
        return 2 if "scp_recon.simulate" in words else 0

    runs = tmp_path / "paper"
    run_first(runs, tmp_path, WANTED, said.append, run)
    assert ran[0] == [sys.executable, "-m", "experiments.observation_table", "--out", str(runs)]
    places = [words[-1] for words in ran[1:]]
    folders = {folder for folder, _ in WANTED} - {there}
    assert sorted(places) == sorted(str(tmp_path / folder) for folder in folders)
    assert all("SOLUTION" not in words for words in ran)
    simulated = next(words for words in ran if "scp_recon.simulate" in words)
    assert simulated[3] == str(runs / PLAN)
    assert said.count("exit status 2: left out") == 1


def test_of_a_plan_of_one_s_own_no_table_is_made(tmp_path: Path) -> None:
    (tmp_path / "solution.json").write_text("{}", "utf-8")
    ran: list[list[str]] = []
    run_first(tmp_path, tmp_path / "studies", WANTED, lambda _: None, lambda w: ran.append(w) or 0)
    assert not [words for words in ran if "experiments.observation_table" in words]
    assert str(tmp_path) in next(words for words in ran if "scp_recon.simulate" in words)
    (tmp_path / "paper").mkdir()
    (tmp_path / "paper" / TABLE).touch()
    run_first(tmp_path / "paper", tmp_path, [], lambda _: None, lambda w: ran.append(w) or 0)
    assert not [words for words in ran if "experiments.observation_table" in words]
