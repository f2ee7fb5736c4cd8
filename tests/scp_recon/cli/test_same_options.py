"""A command has the options of its function, as the function's docstring describes them."""

from __future__ import annotations

import inspect

import pytest

import scp_recon as sr
from scp_recon.cli.commands import COMMANDS
from scp_recon.cli.options import parameters

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
