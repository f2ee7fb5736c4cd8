"""Options of commands: those of the functions, each with its help."""

import inspect

import pytest

import scp_recon as sr
from scp_recon.cli.commands import COMMANDS
from scp_recon.cli.options import joined, parameters
from scp_recon.results.read import read_solution
from tests.scp_recon.support import run_solve

OWN = {"solve": {"file", "out", "report"}, "schema": {"file"}}


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
    assert {*options} - OWN.get(name, {"out"}) == {*known} - {"progress", "out"}
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
