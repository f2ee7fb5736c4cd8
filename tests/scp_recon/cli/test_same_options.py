"""Options of commands and functions are the same, and what cannot be chosen is refused."""

import inspect

import pytest

import scp_recon as sr
from scp_recon.cli.commands import COMMANDS
from scp_recon.cli.options import parameters
from scp_recon.results.read import read_solution
from tests.scp_recon.support import run_solve

PYTHON = {"montecarlo": "fly"}
"""Functions of Python whose names differ from their commands'."""
OWN = {
    "solve": {"file", "out", "report"},
    "design": {"out"},
    "replan": {"out"},
    "simulate": {"out"},
}
"""Options without a parameter: a script saves what a function returns, and `report` is a function."""
DIFFERENT = {("report", "out"), ("export", "out")}
"""Defaults that differ: a command writes beside the plan."""


def test_every_function_has_its_command():
    """But for what commands read and write themselves, and what a report draws. Classes are parts of
    problems by hand.
    """
    verbs = {PYTHON.get(name, name) for name in COMMANDS} - {"solve"} | {"plan"}
    functions = {name for name in sr.__all__ if not inspect.isclass(getattr(sr, name))}
    assert functions - verbs == {"charts", "load", "load_scenario", "read_campaign", "save"}
    assert verbs - functions == {"schema"}


@pytest.mark.parametrize("name", sorted(COMMANDS.keys() - {"schema"}))
def test_options_are_parameters_of_the_function(name):
    function = getattr(sr, {**PYTHON, "solve": "plan"}.get(name, name))
    known = {
        one.name: one.default
        for one in inspect.signature(function).parameters.values()
        if one.name != "progress"
    }
    options = {one.name: one.default for one in parameters(COMMANDS[name].function)}
    assert options.keys() - OWN.get(name, set()) == known.keys() - OWN.get(name, set())
    for option in known.keys() & options.keys():
        if inspect.Parameter.empty not in (known[option], options[option]):
            same = (known[option] or None) == (options[option] or None)
            assert same or (name, option) in DIFFERENT, option


@pytest.mark.parametrize("name", COMMANDS)
def test_every_option_has_its_help(name):
    assert all(action.help for action in COMMANDS[name].parser()._actions)


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
    assert solution.status == "converged"
    assert run.exit_code == 0
    assert solution.total_dv_m_s == pytest.approx(0.107723, rel=1e-4)
