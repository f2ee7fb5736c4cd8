"""The shell of the studies: one way in, --json and --quiet, claims as rows, work taken up again."""

from __future__ import annotations

import json
import math
from pathlib import Path
from types import SimpleNamespace

import pytest

from experiments import frontier, harness
from experiments.__main__ import STUDIES, main, module_of
from experiments.harness import Findings, Record, Study, plan_or_default
from scp_recon.errors import InputError
from scp_recon.jobs.job import Job
from scp_recon.scenario.load import load_scenario

from .support import session_in

PACKAGE = Path(frontier.__file__).parent


def test_every_study_is_listed(capsys: pytest.CaptureFixture[str]) -> None:
    having = {path for path in PACKAGE.rglob("*.py") if "\nSTUDY = " in path.read_text("utf-8")}
    places = {PACKAGE.parent.joinpath(*module_of(name).split(".")) for name in STUDIES}
    assert {place.with_suffix(".py") for place in places} == having
    assert main([]) == 0
    said = capsys.readouterr().out
    assert all(f"  {name} " in said for name in STUDIES)
    assert main(["no_such_study"]) == 2
    assert "battery_cones" in capsys.readouterr().err


@pytest.mark.parametrize(
    "words",
    [
        "battery_cones --samples 1",
        "observation_table --samples 1",
        "observation_table --samples x",
        "timing_rules --slews 2",
        "uncertainty_sources --paths 19",
    ],
)
def test_a_number_out_of_its_range_exits_with_two(words: str) -> None:
    with pytest.raises(SystemExit) as stop:
        main(words.split())
    assert stop.value.code == 2


def test_a_study_refuses_a_plan_that_it_would_fly_open_loop(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    measured = {"navigation.sigma_position_m": 10.0, "navigation.sigma_velocity_m_s": 5e-4}
    scenario = load_scenario().replace({"policy.kind": "feedback", **measured})
    monkeypatch.setattr(harness, "read_solution", lambda _: SimpleNamespace(scenario=scenario))
    with pytest.raises(InputError, match=r"policy.kind: got 'feedback'; goes with"):
        plan_or_default(Path("of_one_s_own"))


def test_a_study_is_one_document_or_silent(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    words = ["battery_cones", "--samples", "100", "--out", str(tmp_path)]
    assert main([*words, "--json"]) == 0
    said = capsys.readouterr()
    document = json.loads(said.out)
    assert document["folder"] == str(tmp_path)
    assert [claim["holds"] for claim in document["claims"]] == [False, True, True]
    assert "written: " in said.err
    assert main([*words, "--quiet"]) == 0
    assert capsys.readouterr() == ("", "")
    assert {str(path) for path in tmp_path.iterdir()} == set(document["files"])


def test_a_study_goes_on_after_ctrl_c(tmp_path: Path) -> None:
    jobs, done, said = [Job(k, k) for k in range(4)], [], list[str]()

    def work(k: int) -> Record:
        if k == 2 and done == [0, 1]:
            raise KeyboardInterrupt
        done.append(k)
        return {"root": math.sqrt(k), "never": math.inf}

    def rows() -> list[Record]:
        with session_in(tmp_path) as session:
            session.say = said.append  # type: ignore[method-assign]
            return session.rows("roots", work, jobs, session.store(), line=lambda r: str(r["root"]))

    with pytest.raises(KeyboardInterrupt):
        rows()
    done.append(-1)  # from now on nothing stops it
    assert [row["root"] for row in rows()] == [math.sqrt(k) for k in range(4)]
    assert done == [0, 1, -1, 2, 3]
    assert said == [str(math.sqrt(k)) for k in (0, 1, 0, 1, 2, 3)]
    assert {row["never"] for row in rows()} == {math.inf}


def test_what_was_kept_goes_once_the_tables_have_it(tmp_path: Path) -> None:
    with session_in(tmp_path) as session:
        for file in ("", "stays.jsonl"):
            session.store(file).put(0, {})
        session.end(Study("", "", lambda _: Findings([], {})), Findings([], {}))
    kept = [path.name for path in tmp_path.iterdir() if not path.name.startswith(".")]
    assert sorted(kept) == ["evidence.json", "stays.jsonl"]
