"""Options of commands: those of the functions, each with its help."""

import inspect
import os

import pytest

import scp_recon as sr
from scp_recon.__main__ import main
from scp_recon.api.inputs import PlanRequest, load, resolve
from scp_recon.api.options import PlanOptions
from scp_recon.cli.commands import COMMANDS
from scp_recon.cli.options import joined, parameters
from scp_recon.results.read import read_solution
from tests.scp_recon.support import run_solve

OWN = {"solve": {"file", "out", "report", "verbose"}, "schema": {"file"}}


def test_every_function_has_its_command():
    """But for what commands read and write themselves, and what a report draws. Classes are parts of
    problems by hand.
    """
    verbs = {command.owner for command in COMMANDS.values()} | {sr.scenarios}
    functions = {name for name in sr.__all__ if not inspect.isclass(getattr(sr, name))}
    alone = {name for name in functions if getattr(sr, name) not in verbs}
    assert alone == {"charts", "load", "load_scenario", "read_campaign", "save"}


@pytest.mark.parametrize("name", COMMANDS)
def test_options_are_those_of_the_function(name):
    command = COMMANDS[name]
    known = inspect.signature(command.owner).parameters if command.owner else {}
    options = [one.name for one in parameters(command.function, command.owner)]
    assert len(options) == len({*options})
    assert {*options} - OWN.get(name, {"out", "verbose"}) == {*known} - {"progress", "out"}
    assert all(action.help for action in command.parser()._actions)


STATE = ["--state", "1", "-2", "3", "-4e-1", "5", "-6"]


@pytest.mark.parametrize(
    ("words", "expected"),
    [
        ([*STATE, "plan"], ["--state=1 -2 3 -4e-1 5 -6", "plan"]),
        ([*STATE, "7"], ["--state=1 -2 3 -4e-1 5 -6", "7"]),
        ([*STATE[:3], "-h"], ["--state=1 -2", "-h"]),
        (["--state", "-h"], ["--state", "-h"]),
        (["--state", "file.txt", "plan"], ["--state=file.txt", "plan"]),
        (["--state=file.txt", "7"], ["--state=file.txt", "7"]),
        (["--state", "1,2,3", "4,5,6", "plan"], ["--state=1,2,3 4,5,6", "plan"]),
        (["--measured-burn", "2=-1", "-2", "-3", "7"], ["--measured-burn=2=-1 -2 -3", "7"]),
        (["--measured-burn", "2=1,2,3", "plan"], ["--measured-burn=2=1,2,3", "plan"]),
    ],
)
def test_list_option_takes_only_its_numbers(words, expected):
    assert joined(words) == expected


@pytest.mark.slow
@pytest.mark.parametrize(
    ("algorithm", "solver"), [("ptr", "clarabel"), ("scvx-star", "CLARABEL"), ("scvx", "ecos")]
)
def test_algorithm_and_solver_are_recorded(tmp_path, algorithm, solver):
    if solver == "ecos":
        pytest.importorskip("ecos")
    run = run_solve(tmp_path, "--algorithm", algorithm, "--solver", solver, "--problem", "P3")
    solution = read_solution(tmp_path)
    assert (solution.algorithm, solution.solver) == (algorithm, solver.upper())
    assert (run.exit_code, solution.status) == (0, "converged")
    assert solution.total_dv_m_s == pytest.approx(0.107723, rel=1e-4)


def test_no_certificate_is_asked_of_uniform_risk(scenario):
    assert scenario.risk.allocation == "uniform"
    PlanOptions(certify=False).check(scenario)


@pytest.mark.parametrize(
    ("problem", "override", "warned"),
    [
        ("P3", "risk.p_chance=0.8", True),
        ("P3", "navigation.lead_s=900", True),
        ("P3", 'policy.kind="open"', True),
        ("P3", "burns.dv_max_m_s=0.2", False),
        ("P2", "risk.p_chance=0.8", False),
        ("P2", 'policy.cost="expected"', True),
    ],
)
def test_override_without_effect_is_warned_about(problem, override, warned):
    request = PlanRequest(options=PlanOptions(problem), overrides=[override])
    warnings = resolve(load(request), request).mission.warnings
    idle = [one.entry for one in warnings if "has no effect" in one.expected]
    assert idle == [override.partition("=")[0]] * warned


FOREIGN = {
    "schema {}/mine.json": "FILE",
    "windows recon_b --span-days 0.2 --csv {}/mine.csv": "--csv",
    "windows recon_b --span-days 0.2 --chart {}/mine.png": "--chart",
    "solve --out {}": "--out",
    "design nightingale --out {}": "--out",
}


@pytest.mark.slow
@pytest.mark.parametrize("line", FOREIGN)
def test_file_that_was_not_written_here_is_kept(line, tmp_path, capsys):
    names = ("mine.json", "mine.csv", "mine.png", "solution.json", "scenario.toml", "design.csv")
    for name in names:
        (tmp_path / name).write_text('{"of": "the user"}', "utf-8")
    assert main(line.format(tmp_path).split()) == 2
    said = capsys.readouterr().err
    assert said.startswith(f"error: {FOREIGN[line]}: got")
    assert "which holds something else" in said
    assert {path.read_text("utf-8") for path in tmp_path.iterdir()} == {'{"of": "the user"}'}


@pytest.mark.parametrize("line", ["schema {}/mine.json", "windows recon_b --csv {}/mine.csv"])
def test_own_file_is_written_again(line, tmp_path, capsys):
    for _ in range(2):
        assert main(line.format(tmp_path).split()) == 0
    assert capsys.readouterr().err == ""


@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="there are no pipes here")
def test_pipe_in_a_solutions_place_is_refused(tmp_path, capsys):
    os.mkfifo(tmp_path / "solution.json")
    for line in (["verify", str(tmp_path)], ["solve", "--out", str(tmp_path)]):
        assert main(line) == 2
    assert "a pipe" in capsys.readouterr().err
