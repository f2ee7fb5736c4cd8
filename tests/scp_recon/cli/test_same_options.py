"""Commands and the Python interface have the same options, but for what is listed here with reasons."""

from __future__ import annotations

import argparse
import inspect

import pytest

import scp_recon as sr
from scp_recon.__main__ import COMMANDS, command

VERBS = {name: name for name in COMMANDS if name != "schema"} | {
    "solve": "plan",
    "montecarlo": "fly",
}
"""The function of each command; a format's schema is no matter of a script."""

ONLY_COMMANDS = {
    "help": "",
    "json": "a script has the results themselves",
    "quiet": "the library never prints",
    "out": "a script saves what a function returns, or names its file as an argument",
    "report": "`report` is a function",
}
"""Options without a parameter, and why."""
ONLY_PYTHON = {
    "progress": "a script may show how a flight goes on; a command does",
}
"""Parameters without an option, and why."""


def options_of(name: str) -> set[str]:
    p: argparse.ArgumentParser = command(name).parser()
    return {action.dest for action in p._actions} - ONLY_COMMANDS.keys()


def parameters_of(name: str) -> set[str]:
    parameters = inspect.signature(getattr(sr, VERBS[name])).parameters
    return {*parameters} - ONLY_COMMANDS.keys() - ONLY_PYTHON.keys()


@pytest.mark.parametrize("name", VERBS)
def test_a_command_and_its_function_have_the_same_options(name: str) -> None:
    assert options_of(name) == parameters_of(name)


def test_every_verb_has_its_command() -> None:
    """But for reading and writing what commands read and write themselves."""
    assert {*sr.__all__} - {*VERBS.values()} == {"load", "load_scenario", "save"}


@pytest.mark.parametrize("name", VERBS)
def test_a_command_and_its_function_have_the_same_defaults(name: str) -> None:
    parameters = inspect.signature(getattr(sr, VERBS[name])).parameters
    for action in command(name).parser()._actions:
        parameter = parameters.get(action.dest)
        if parameter is None or action.required or parameter.default is parameter.empty:
            continue
        given = action.default if action.default != [] else ()
        if parameter.default is None or given is None or action.dest == "out":
            continue  # what stands for the default is said where it is decided
        assert given == parameter.default, action.dest
