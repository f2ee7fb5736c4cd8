"""Make a command's parser from functions: signatures and docstrings become options and help.

A command takes the options of the function of `api` that does its work, with that function's
descriptions, and adds its own. Types of options convert texts to numbers; `api` checks their ranges.
"""

from __future__ import annotations

import argparse
import inspect
import re
import types
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, Literal, NamedTuple, Union, get_args, get_origin

from scp_recon.errors import EXACT, InputError, whole_number

WHOLE = re.compile(r"[+-]?[0-9]{1,20}")
"""Longer ones are beyond every bound, and slow to read."""


def whole(text: str) -> int | str:
    """A type of option: a whole number, also 1e4; other texts pass, and `api` refuses them."""
    if WHOLE.fullmatch(text):
        return int(text)
    try:
        return whole_number("", number(text), -int(EXACT), int(EXACT))
    except InputError:
        return text


def number(text: str) -> float | str:
    """A type of option: a number; other texts pass, and `api` refuses them with its bounds."""
    try:
        return float(text)
    except ValueError:
        return text


def numbers(text: str) -> tuple[float, ...] | str:
    """A type of option: numbers with commas or spaces; other texts pass, and `api` refuses them."""
    found = tuple(number(word) for word in text.replace(",", " ").split())
    floats = tuple(x for x in found if isinstance(x, float))
    return floats if floats == found else text


def folder(text: str) -> Path:
    """A type of option: a folder with a name that is not empty."""
    if not text:
        raise argparse.ArgumentTypeError("got ''; must be a folder")
    return Path(text)


def yes_or_no(text: str) -> bool:
    """A type of option: a choice."""
    if text not in ("yes", "no"):
        raise argparse.ArgumentTypeError(f"got {text!r}; must be yes or no")
    return text == "yes"


def width(text: str) -> float:
    """A type of option: an interval's width in percent."""
    try:
        found = float(text.removesuffix("%")) / 100.0
    except ValueError:
        found = 0.0
    if not text.endswith("%") or not 0.0 < found < 1.0:
        raise argparse.ArgumentTypeError(f"got {text!r}; must be a percentage such as 0.5%")
    return found


def start(text: str) -> str:
    """A type of option: where planning begins."""
    if not text:
        raise argparse.ArgumentTypeError("got ''; must be cold, warm or a file")
    return text


def budget(text: str) -> float | str | None:
    """A type of option: a number, or any."""
    return None if text == "any" else number(text)


class Option(NamedTuple):
    """How the command line spells a parameter.

    Attributes:
        metavar: placeholder of the value in the help; empty for the usual one of the type.
        flag: such as --set; empty for the parameter's name.
        read: converts the text of the value; None for the conversion of the type.
        help: description where several functions say the same in words of Python.
    """

    metavar: str = ""
    flag: str = ""
    read: Callable[[str], Any] | None = None
    help: str = ""


SPELT: Mapping[str, Option] = {
    "file": Option("SCENARIO"),
    "verbose": Option(flag="-v"),
    "scenario": Option("SCENARIO", read=Path),
    "init": Option("cold|warm|FILE", read=start),
    "facet_rounds": Option("N|settle", read=whole),
    "starts": Option("N|auto", read=whole),
    "dv_budget_m_s": Option("M_S", "--dv-budget", budget),
    "overrides": Option(
        "PATH=VALUE",
        "--set",
        help="override one entry of the scenario, e.g. risk.p_chance=0.8; may be repeated",
    ),
    "certify": Option(
        help="with risk.allocation = exact, raise the target probability until fresh flights reach the "
        "required one (default: yes)"
    ),
    "out": Option("DIR", read=folder),
    "plan": Option("PLAN", read=Path, help="folder with a solution.json, or the file"),
    "plans": Option("PLAN", read=Path),
    "at_s": Option("T", "--at", str),
    "state": Option("STATE", "--state", str),
    "covariance": Option("FILE", read=Path),
    "measured_burns": Option("N=X,Y,Z", "--measured-burn"),
    "study": Option("STUDY", read=Path),
    "scheduler": Option("ADDRESS"),
    "until": Option("P%", read=width),
    "field_deg": Option("DEG"),
    "format": Option("", "--format"),
    "body": Option("NAME", "--body"),
    "site": Option("LAT,LON", "--site", numbers),
    "pole": Option("RA,DEC", read=numbers),
    "orbit": Option("X,Y,Z,VX,VY,VZ", read=numbers),
    "epoch": Option("TDB", read=str),
    "begin": Option("TIME", "--from", str),
    "end": Option("TIME", "--to", str),
}
"""Parameters, of any command, of which name and type do not say how they are spelt."""
USUAL: dict[Any, dict[str, Any]] = {
    bool: {"type": yes_or_no, "metavar": "yes|no"},
    int: {"type": whole, "metavar": "N"},
    float: {"type": number, "metavar": "X"},
    Path: {"type": Path, "metavar": "FILE"},
    str: {"metavar": "NAME"},
}
"""Arguments of `add_argument` by the type of a parameter."""
DESCRIBED = re.compile(r"^ {4}(\w+): (.*(?:\n {8}.*)*)", re.MULTILINE)
"""A parameter in the `Args:` of a docstring, and its description."""
IN_PYTHON = ("progress",)
"""Parameters without an option."""


def parameters(
    function: Callable[..., Any], owner: Callable[..., Any] | None
) -> list[inspect.Parameter]:
    """Parameters of a command that are arguments or options, each once.

    They are those of the command's function but for the console; where it takes any others (`**given`),
    those of its owner follow, which by keyword alone are before its own.
    """
    own = list(inspect.signature(function).parameters.values())[1:]
    names = [one.name for one in own]
    others = () if owner is None else inspect.signature(owner).parameters.values()
    taken = [one for one in others if one.name not in (*names, *IN_PYTHON)]
    first = [one for one in own if one.kind is one.POSITIONAL_OR_KEYWORD]
    return [*first, *taken, *(one for one in own if one.kind is one.KEYWORD_ONLY)]


def described(function: Callable[..., Any]) -> tuple[str, dict[str, str]]:
    """What a docstring says before its sections, and of each parameter.

    Values stand without their quotes, and a last sentence on Python is left out.
    """
    said, _, sections = (inspect.getdoc(function) or "").partition("\n\nArgs:\n")
    words = {name: " ".join(text.split()) for name, text in DESCRIBED.findall(sections)}
    return " ".join(said.split()), {
        name: text.replace('"', "").partition(" In Python ")[0] for name, text in words.items()
    }


def parser_of(
    function: Callable[..., Any],
    owner: Callable[..., Any] | None,
    spelt: Mapping[str, Option],
    prog: str,
) -> argparse.ArgumentParser:
    """Make the parser of a command.

    Args:
        function: of the command. Parameters by keyword alone, and those with a default of the owner,
            are options, the others arguments; a parameter without a default is required.
        owner: function of `api` whose parameters the command takes too.
        spelt: parameters that this command spells in another way than the others.
        prog: name of the command for its help.
    """
    said, words = described(function)
    shared = {name: option.help for name, option in SPELT.items() if option.help}
    words = (described(owner)[1] if owner else {}) | shared | words
    p = argparse.ArgumentParser(prog=prog, description=said)
    spelt = {**SPELT, **spelt}
    rows = [(one, spelt.get(one.name, Option())) for one in parameters(function, owner)]
    flags = {one.name: o.flag or f"--{one.name.replace('_', '-')}" for one, o in rows}
    own = inspect.signature(function).parameters
    for one, option in rows:
        by_keyword = one.kind is one.KEYWORD_ONLY or bool(option.flag)
        by_keyword |= one.name not in own and one.default is not one.empty
        row = _row(one, option, by_keyword=by_keyword)
        help_ = words.get(one.name, "").removesuffix(".").replace("%", "%%")
        if type(one.default) in (str, int, float):
            help_ += f" (default: {one.default:{'g' if type(one.default) is float else ''}})"
        row["help"] = re.sub("`(.+?)`", lambda match: flags.get(match[1], match[1]), help_)
        if by_keyword:
            p.add_argument(flags[one.name], dest=one.name, **row)
        else:
            p.add_argument(one.name, **row)
    return p


def _kind(annotation: Any) -> Any:
    """Type of a parameter's values on the command line: a path, where it may be one."""
    if get_origin(annotation) in (Union, types.UnionType):
        kinds = [kind for kind in get_args(annotation) if kind is not types.NoneType]
        return Path if Path in kinds else kinds[0]
    return annotation


def _row(one: inspect.Parameter, option: Option, *, by_keyword: bool) -> dict[str, Any]:
    """Arguments of `add_argument` for a parameter, without its help."""
    required, kind = one.default is one.empty, _kind(one.annotation)
    if kind is bool and one.default is False:
        return {"action": "store_true"}
    row: dict[str, Any] = {} if required else {"default": one.default}
    if one.kind is one.VAR_POSITIONAL:
        row = {"nargs": "+"}
    elif one.name in REPEATED:
        row, kind = {"action": "append", "default": []}, str
    elif by_keyword:
        row["required"] = required
    elif not required:
        row["nargs"] = "?"
    if get_origin(kind) is Literal:
        row["metavar"] = "|".join(get_args(kind))
    row |= USUAL.get(kind, {})
    row |= {"type": option.read} if option.read else {}
    return row | ({"metavar": option.metavar} if option.metavar else {})


REPEATED = ("overrides", "measured_burns")
LISTS = {"--state": 6, "--measured-burn": 3, "--orbit": 6, "--site": 2, "--pole": 2}
"""Options whose value is so many numbers, which may be negative and stand apart."""


def joined(arguments: Sequence[str]) -> list[str]:
    """Join each list of numbers into one argument, so that a leading minus makes no option.

    A list takes only numbers, and at most its own count; the rest belongs to other arguments.
    """
    found: list[str] = []
    for argument in arguments:
        name, separator, value = found[-1].partition("=") if found else ("", "", "")
        if name in LISTS and _goes_on(name, value if separator else None, argument):
            found[-1] += f" {argument}" if separator else f"={argument}"
        else:
            found.append(argument)
    return found


def _goes_on(name: str, value: str | None, argument: str) -> bool:
    """Whether an argument belongs to a list's value so far, None before it has begun."""
    more = _count(argument)
    if value is None:
        return more is not None or not argument.startswith("-")
    so_far = _count(value.partition("=")[2] if name == "--measured-burn" else value)
    return so_far is not None and more is not None and so_far + more <= LISTS[name]


def _count(text: str) -> int | None:
    """Number of numbers in a text; None if it holds anything else."""
    found = [number(part) for part in text.replace(",", " ").split()]
    return len(found) if all(isinstance(x, float) for x in found) else None
