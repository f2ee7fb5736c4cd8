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
from contextlib import suppress
from datetime import datetime
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, NamedTuple, Union, get_args, get_origin

from scp_recon.errors import EXACT, InputError, shortened, whole_number

if TYPE_CHECKING:
    from scp_recon.replanning.remainder import Delivery

WHOLE = re.compile(r"[+-]?[0-9]{1,20}")
"""Whole number of at most 20 digits: longer ones are beyond every bound, and slow to read."""


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


def matching(pattern: str, allowed: str, convert: Callable[[str], Any]) -> Callable[[str], Any]:
    """A type of option: texts of a pattern alone."""

    def read(text: str) -> Any:
        if not re.fullmatch(pattern, text):
            raise argparse.ArgumentTypeError(f"got {text!r}; must be {allowed}")
        return convert(text)

    return read


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


FOLDER = matching("(?s).+", "a folder", Path)
START = matching("(?s).+", "cold, warm or a file", str)
YES_OR_NO = matching("yes|no", "yes or no", lambda text: text == "yes")
"""Types of options."""


def width(text: str) -> float:
    """A type of option: an interval's width in percent."""
    found = number(text.removesuffix("%"))
    if isinstance(found, str) or not text.endswith("%") or not 0.0 < found < 100.0:
        raise argparse.ArgumentTypeError(f"got {text!r}; must be a percentage such as 0.5%")
    return found / 100.0


def budget(text: str) -> float | str | None:
    """A type of option: a number, or any."""
    return None if text == "any" else number(text)


SPELT: Mapping[str, Option] = {
    "file": Option("SCENARIO"),
    "verbose": Option(flag="-v"),
    "scenario": Option("SCENARIO", read=Path),
    "init": Option("cold|warm|FILE", read=START),
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
    "out": Option("DIR", read=FOLDER),
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
    bool: {"type": YES_OR_NO, "metavar": "yes|no"},
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
    """Make the parser of a command from its function and its owner in `api`, for its name `prog`.

    Parameters by keyword alone, and those with a default of the owner, are options, the others
    arguments; a parameter without a default is required.
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
        if name in LISTS and not separator and (_count(argument) or not argument.startswith("-")):
            found[-1] += f"={argument}"
        elif name in LISTS and separator and (more := _count(argument)):
            so_far = _count(value.partition("=")[2] if name == "--measured-burn" else value)
            if so_far and so_far + more <= LISTS[name]:
                found[-1] += f" {argument}"
            else:
                found.append(argument)
        else:
            found.append(argument)
    return found


def _count(text: str) -> int:
    """Number of numbers in a text; 0 if it holds anything else."""
    found = numbers(text)
    return 0 if isinstance(found, str) else len(found)


BYTES_MAX = 100_000
"""Most bytes of a file of 36 numbers with comments."""


def read_delivery(
    epoch: datetime,
    *,
    at_s: str,
    state: str,
    covariance: Path | None,
    measured_burns: Sequence[str],
    **frames: str,
) -> Delivery:
    """Make a delivery from options of `replan`, for a plan of that epoch, TDB.

    The state is six numbers, m and m/s, or their file; the covariance a file of six rows of six; each
    measured burn N=X,Y,Z, m/s; `frames` are as of `Delivery.of`.
    """
    from scp_recon.replanning.remainder import Delivery

    rows = None if covariance is None else _rows(covariance, "--covariance")
    if rows is not None and [len(row) for row in rows] != 6 * [6]:
        sizes = " and ".join(sorted({str(len(row)) for row in rows})) or "no"
        given, allowed = f"{len(rows)} rows of {sizes} numbers", "must be six rows of six numbers"
        raise InputError(f"--covariance {covariance}", given, f"{allowed}, m and m/s")
    six = numbers(state)
    if isinstance(six, str):
        six = tuple(number for row in _rows(Path(state), "--state") for number in row)
    if len(six) != 6:
        allowed = "must be six, m and m/s, or their file"
        raise InputError("--state", f"{len(six)} numbers", allowed)
    burns: dict[int, tuple[float, ...]] = {}
    for text in measured_burns:
        index, _, burn = text.partition("=")
        three = numbers(burn)
        if not WHOLE.fullmatch(index.strip()) or isinstance(three, str) or len(three) != 3:
            allowed = "must read N=X,Y,Z: the burn's number and three numbers in m/s"
            raise InputError("--measured-burn", shortened(text), allowed)
        if int(index) in burns:
            raise InputError("--measured-burn", f"burn {index} twice", "must be given once")
        burns[int(index)] = three
    return Delivery.of(_time(at_s, epoch), six, covariance=rows, measured=burns, **frames)


def _time(text: str, epoch: datetime) -> float:
    """Seconds past the epoch, given as such or as a date."""
    if isinstance(found := number(text), float):
        return found
    with suppress(ValueError):
        if (date := datetime.fromisoformat(text)).tzinfo is None:
            return (date - epoch).total_seconds()
    allowed = "must be seconds past the plan's epoch, or a date in TDB such as 2020-01-22T01:16:37"
    raise InputError("--at", shortened(text), allowed)


def _rows(path: Path, entry: str) -> list[tuple[float, ...]]:
    """Numbers of a file, line by line; text after a # is ignored."""
    from scp_recon.files import read_text

    text = read_text(path, f"{entry} {path}", "file of numbers", BYTES_MAX)
    lines = (line.partition("#")[0] for line in text.splitlines())
    found = []
    for row in (numbers(line) for line in lines if line.strip()):
        if isinstance(row, str):
            raise InputError(f"{entry} {path}", shortened(row), "must be a file of numbers")
        found.append(row)
    return found
