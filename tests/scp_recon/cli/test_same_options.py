"""Options of commands and functions are the same, and what cannot be chosen is refused."""

from __future__ import annotations

import inspect
from pathlib import Path

import pytest

import scp_recon as sr
from scp_recon.cli.commands import COMMANDS
from scp_recon.cli.options import parameters
from scp_recon.results.read import read_solution
from tests import reliability
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


def test_every_verb_has_its_command() -> None:
    """But for what commands read and write themselves, and what a report draws. Classes are parts of
    problems by hand.
    """
    verbs = {function.rpartition(".")[2] for function in FUNCTIONS.values()}
    functions = {name for name in sr.__all__ if not inspect.isclass(getattr(sr, name))}
    assert functions - verbs == {"charts", "load", "load_scenario", "read_campaign", "save"}
    assert COMMANDS.keys() - FUNCTIONS.keys() == {"schema"}


@pytest.mark.parametrize("name", COMMANDS)
def test_options_are_those_of_the_function(name: str) -> None:
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


P3_EXACT = ("--problem", "P3", "--set", "risk.allocation=exact")


@pytest.mark.parametrize(
    ("algorithm", "solver"), [("ptr", "clarabel"), ("scvx-star", "CLARABEL"), ("scvx", "ecos")]
)
def test_algorithm_and_solver_are_recorded(tmp_path: Path, algorithm: str, solver: str) -> None:
    if solver == "ecos":
        pytest.importorskip("ecos")
    run = run_solve(tmp_path, "--algorithm", algorithm, "--solver", solver, "--problem", "P3")
    solution = read_solution(tmp_path)
    assert (solution.algorithm, solution.solver) == (algorithm, solver.upper())
    assert solution.status == "converged"
    assert run.exit_code == 0
    assert solution.total_dv_m_s == pytest.approx(0.107723, rel=1e-4)


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (("--problem", "P4"), "--problem: got 'P4'; must be one of P2, P3"),
        (("--formulation", "folded"), "--formulation: got 'folded'; must be one of condensed"),
        (("--facet-rounds", "-1"), "--facet-rounds: got"),
        *(
            (("--facet-rounds", n), f"got '{n}'" if n == "many" else f"got {n}; must be a whole")
            for n in ("many", "1000000")
        ),
        (("--unknown",), "error: got --unknown; there is no such option"),
        (("--init", ""), "--init: got ''; must be cold, warm or a file"),
        (("--out", ""), "--out: got ''; must be a folder"),
        *(
            ((f"--starts={n}",), "must be a whole number from 1 to 1000")
            for n in ("0", "two", "1.5", "1001")
        ),
        (("--algorithm", "sqp"), "--algorithm: got 'sqp'; must be one of scvx, ptr, scvx-star"),
        (("--solver", "simplex"), "--solver: got 'SIMPLEX'; must be one of CLARABEL"),
        (("--method", "ipopt", "--solver", "ECOS"), "--solver: got ECOS; goes with --method scp"),
        (("--method", "ipopt", "--algorithm", "ptr"), "--algorithm: got ptr; goes with"),
        (("--method", "ipopt", "--starts", "2"), "--starts: got 2; goes with --method scp only"),
        (("--method", "ipopt", "--seed", "0"), "--seed: got 0; goes with --method scp only"),
        (("--seed", "0"), "--seed: got 0; goes with --starts of 2 or more"),
        (("--starts", "1", "--workers", "2"), "--workers: got 2; goes with --starts of 2 or more"),
        (
            ("--starts", "2", "--objective", "probability", "--set", "risk.allocation=exact"),
            "--starts: got 2; goes with --objective delta-v",
        ),
        (
            ("--objective", "probability", "--dv-budget", "115", "--set", "risk.allocation=exact"),
            "--dv-budget: got 115 m/s; must be at most 0.8 m/s, all burns at burns.dv_max_m_s",
        ),
        (("--certify", "yes"), "--certify: got yes; goes with risk.allocation = exact only"),
        ((*P3_EXACT, "--certify", "yes"), "--certify: got yes; goes with --problem P2"),
        ((*P3_EXACT, "--certify", "no"), "--certify: got no; goes with --problem P2"),
        ((*P3_EXACT, "--objective", "probability"), "--objective: got probability; goes with"),
        (
            ("--starts", "2", "--set", "risk.allocation=exact", "--set", "risk.p_chance=0.9999"),
            "risk.p_chance: got 0.9999; takes 3000000 flights to certify",
        ),
    ],
)
def test_what_cannot_be_chosen_is_refused(
    tmp_path: Path, arguments: tuple[str, ...], words: str
) -> None:
    run = run_solve(tmp_path / "out", *arguments)
    assert (run.exit_code, run.output) == (2, "")
    assert words in " ".join(run.errors.split())
    assert list(tmp_path.rglob("*.json")) == []
    reliability.count(reliability.BAD_INPUTS)
