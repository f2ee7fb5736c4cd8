"""Options of commands and functions are the same, and what cannot be chosen is refused."""

import inspect

import pytest

import scp_recon as sr
from scp_recon.cli.commands import COMMANDS
from scp_recon.cli.options import parameters
from scp_recon.results.read import read_solution
from tests.scp_recon.support import run_solve

FUNCTIONS = {name: command.function for name, command in COMMANDS.items() if command.function}
OWN = {
    "solve": {"file", "out", "report"},
    "design": {"out"},
    "replan": {"out"},
    "simulate": {"out"},
    "schema": {"file"},
}
"""Options without a parameter: a script saves what a function returns, and `report` is a function."""


def test_every_verb_has_its_command():
    """But for what commands read and write themselves, and what a report draws. Classes are parts of
    problems by hand.
    """
    verbs = {function.rpartition(".")[2] for function in FUNCTIONS.values()}
    functions = {name for name in sr.__all__ if not inspect.isclass(getattr(sr, name))}
    assert functions - verbs == {"charts", "load", "load_scenario", "read_campaign", "save"}
    assert COMMANDS.keys() - FUNCTIONS.keys() == {"schema"}


@pytest.mark.parametrize("name", COMMANDS)
def test_options_are_those_of_the_function(name):
    """What is read of a function is what Python knows of it, and all of it is described."""
    function = FUNCTIONS.get(name)
    read = parameters(function) if function else []
    known = (
        inspect.signature(getattr(sr, function.rpartition(".")[2])).parameters if function else {}
    )
    assert {one.name: (one.annotation, one.default, one.required) for one in read} == {
        one.name: (
            one.annotation.replace('"', "'"),
            None if one.default is one.empty else one.default,
            one.default is one.empty,
        )
        for one in known.values()
        if one.name != "progress"
    }
    actions = {action.dest: action for action in COMMANDS[name].parser()._actions}
    assert all(action.help for action in actions.values())
    own = actions.keys() - known.keys() - {"help"}
    assert own == OWN.get(name, set())


@pytest.mark.parametrize(
    ("algorithm", "solver"), [("ptr", "clarabel"), ("scvx-star", "CLARABEL"), ("scvx", "ecos")]
)
def test_algorithm_and_solver_are_recorded(tmp_path, algorithm, solver):
    if solver == "ecos":
        pytest.importorskip("ecos")
    run = run_solve(tmp_path, "--algorithm", algorithm, "--solver", solver, "--problem", "P3")
    solution = read_solution(tmp_path)
    assert (solution.algorithm, solution.solver) == (algorithm, solver.upper())
    assert solution.status == "converged"
    assert run.exit_code == 0
    assert solution.total_dv_m_s == pytest.approx(0.107723, rel=1e-4)
