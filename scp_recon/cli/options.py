"""Make a command's parser from its function: signature and docstring become options and help.

Types of options convert texts to numbers; `api` checks their ranges. Whatever several commands
share stands here once, as types of parameters.
"""

from __future__ import annotations

import argparse
import inspect
import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from types import NoneType
from typing import Annotated, Any, Literal, get_args, get_origin

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


def int_between(low: int, high: int, words: str = "") -> Callable[[str], int]:
    """A type of option: whole numbers within bounds, named in `words` if these are shorter."""

    def parse(text: str) -> int:
        try:
            return whole_number("", whole(text), low, high)
        except InputError:
            allowed = words or f"{low} to {high}"
            said = f"got {text!r}; must be a whole number from {allowed}"
            raise argparse.ArgumentTypeError(said) from None

    return parse


def named_folder(text: str) -> Path:
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


@dataclass(frozen=True)
class Option:
    """The metadata of a parameter's `Annotated` type, for an option that its type does not describe.

    Attributes:
        metavar: placeholder of the value in the help; empty for the usual one of the type.
        flag: such as --set; empty for the parameter's name.
        read: converts the text of the value; None for the conversion of the type.
        help: description; empty if the function's docstring has one.
    """

    metavar: str = ""
    flag: str = ""
    read: Callable[[str], Any] | None = None
    help: str = ""


PlanFile = Annotated[Path, Option("PLAN", help="folder with a solution.json, or the file")]
Overrides = Annotated[
    list[str],
    Option(
        "PATH=VALUE",
        "--set",
        help="override one entry of the scenario, e.g. risk.p_chance=0.8; may be repeated",
    ),
]
Certify = Annotated[
    bool | None,
    Option(
        help="with risk.allocation = exact, raise the target probability until fresh flights reach the "
        "required one (default: yes)"
    ),
]
RUN = (
    "(default: runs/NAME/UTC with the scenario's name, to which runs/latest then points); a verified "
    "plan there is overwritten only by a verified one"
)
RunFolder = Annotated[
    Path | None, Option("DIR", read=named_folder, help=f"folder for solution.json {RUN}")
]
Folder = Annotated[Path, Option("DIR")]
Scheduler = Annotated[
    str | None,
    Option(
        "ADDRESS",
        help="run on the Dask cluster of this scheduler instead, e.g. tcp://127.0.0.1:8786; needs the "
        "extra [cluster]",
    ),
]
Vehicle = Annotated[Path | None, Option(help="a TOML file (default: the packaged DARE)")]
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


def parameters(function: Callable[..., Any]) -> list[inspect.Parameter]:
    """Parameters of a command's function that are options: all but the first, the console."""
    return list(inspect.signature(function).parameters.values())[1:]


def parser_of(function: Callable[..., Any], prog: str) -> argparse.ArgumentParser:
    """Make the parser of a command.

    Args:
        function: of the command. Parameters by keyword alone are options, the others arguments; a
            parameter without a default is required.
        prog: name of the command for its help.
    """
    said, _, section = inspect.getdoc(function).partition("\n\nArgs:\n")  # type: ignore[union-attr]
    described = {name: " ".join(text.split()) for name, text in DESCRIBED.findall(section)}
    p = argparse.ArgumentParser(prog=prog, description=" ".join(said.split()))
    rows = [(one, *_kind_and_option(one.annotation)) for one in parameters(function)]
    flags = {one.name: o.flag or f"--{one.name.replace('_', '-')}" for one, _, o in rows}
    for one, kind, option in rows:
        row = _row(one, kind, option)
        said = (described.get(one.name) or option.help).removesuffix(".").replace("%", "%%")
        if type(one.default) in (str, int, float):
            said += f" (default: {one.default:{'g' if type(one.default) is float else ''}})"
        row["help"] = re.sub("`(.+?)`", lambda match: flags.get(match[1], match[1]), said)
        if one.kind is inspect.Parameter.KEYWORD_ONLY:
            p.add_argument(flags[one.name], dest=one.name, **row)
        else:
            p.add_argument(one.name, **row)
    return p


def _kind_and_option(annotation: Any) -> tuple[Any, Option]:
    """Type of a parameter without its `| None`, and its metadata."""
    found = Option()
    if get_origin(annotation) is Annotated:
        annotation, found = get_args(annotation)
    if NoneType in get_args(annotation):
        (annotation,) = (kind for kind in get_args(annotation) if kind is not NoneType)
    return annotation, found


def _row(one: inspect.Parameter, kind: Any, option: Option) -> dict[str, Any]:
    """Arguments of `add_argument` for a parameter, without its help."""
    by_keyword, required = one.kind is one.KEYWORD_ONLY, one.default is one.empty
    if kind is bool and one.default is False:
        return {"action": "store_true"}
    row: dict[str, Any] = {} if required else {"default": one.default}
    if get_origin(kind) is list:
        (kind,) = get_args(kind)
        row |= {"action": "append"} if by_keyword else {"nargs": "+"}
    elif by_keyword:
        row["required"] = required
    elif not required:
        row["nargs"] = "?"
    if get_origin(kind) is Literal:
        row["metavar"] = "|".join(get_args(kind))
    row |= USUAL.get(kind, {})
    row |= {"type": option.read} if option.read else {}
    return row | ({"metavar": option.metavar} if option.metavar else {})


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
