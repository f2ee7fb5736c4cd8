"""Make the options of commands from the functions of `api`; docstrings of parameters become help.

Types of options convert texts to numbers; `api` checks their ranges.
"""

from __future__ import annotations

import argparse
import ast
import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

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


ROWS: dict[str, dict[str, Any]] = {
    "at_s": {
        "flag": "--at",
        "type": str,
        "metavar": "T",
        "help": "time of the state: s past the plan's epoch, or a date in TDB; burns until then are "
        "flown",
    },
    "begin": {"flag": "--from", "metavar": "TIME"},
    "covariance": {
        "type": Path,
        "metavar": "FILE",
        "help": "six rows of six numbers, m and m/s (default: the scenario's initial covariance)",
    },
    "dv_budget_m_s": {
        "flag": "--dv-budget",
        "type": lambda text: None if text == "any" else number(text),
        "metavar": "M_S",
    },
    "end": {"flag": "--to", "metavar": "TIME"},
    "epoch": {"metavar": "TDB"},
    "field_deg": {"metavar": "DEG"},
    "init": {"type": start, "metavar": "cold|warm|FILE"},
    "measured_burns": {
        "flag": "--measured-burn",
        "type": str,
        "action": "append",
        "default": [],
        "metavar": "N=X,Y,Z",
        "help": "a flown burn as telemetry saw it, m/s, by its number in the flight; may be repeated",
    },
    "orbit": {"type": numbers, "metavar": "X,Y,Z,VX,VY,VZ"},
    "overrides": {
        "flag": "--set",
        "action": "append",
        "default": [],
        "metavar": "PATH=VALUE",
        "help": "override one entry of the scenario, e.g. risk.p_chance=0.8; may be repeated",
    },
    "plan": {"type": Path, "metavar": "PLAN", "help": "folder with a solution.json, or the file"},
    "plans": {
        "nargs": "+",
        "type": Path,
        "metavar": "PLAN",
        "help": "folder with a solution.json, or the file",
    },
    "policy": {"metavar": "open|replan|feedback"},
    "pole": {"type": numbers, "metavar": "RA,DEC"},
    "scheduler": {"metavar": "ADDRESS"},
    "scenario": {"type": Path, "metavar": "SCENARIO"},
    "site": {"type": numbers, "metavar": "LAT,LON"},
    "state": {
        "metavar": "STATE",
        "help": "x y z in m and vx vy vz in m/s at that time, after burns flown, or a file of these "
        "six",
    },
    "study": {"type": Path, "metavar": "STUDY", "help": "TOML file; see docs/campaigns.md"},
    "truth": {"metavar": "planner|harmonics|polyhedron"},
    "errors": {"metavar": "componentwise|gates"},
    "format": {"metavar": "oem|spk|ck|csv|parquet"},
    "until": {
        "type": width,
        "metavar": "P%",
        "help": "stop when every joint probability's interval is this narrow, e.g. 0.5%%",
    },
}
"""What an option has that does not follow from the parameter of its name."""
BY_TYPE: tuple[tuple[str, dict[str, Any]], ...] = (
    ("bool | None", {"type": yes_or_no, "metavar": "yes|no"}),
    ("bool", {"action": "store_true"}),
    ("int", {"type": whole, "metavar": "N"}),
    ("float", {"type": number, "metavar": "X"}),
    ("Path", {"type": Path, "metavar": "FILE"}),
    ("str", {"metavar": "NAME"}),
)
"""What follows from a parameter's type."""
PACKAGE = Path(__file__).parents[1]
ARGUMENT = re.compile(r"^ {4}(\w+): (.*(?:\n {8}.*)*)", re.MULTILINE)


@dataclass(frozen=True)
class Parameter:
    """A parameter of a function.

    Attributes:
        name: of it.
        annotation: its type, as in the source.
        default: its value if it is not given.
        required: whether it has no default.
        first: whether it is the first one, which needs no flag.
        said: its description in the function's docstring.
    """

    name: str
    annotation: str
    default: Any
    required: bool
    first: bool
    said: str


def parameters(function: str) -> list[Parameter]:
    """Parameters of a function, read from the source: importing it would take a second.

    `progress` is left out: a command shows progress in its own way.

    Args:
        function: module and name, such as `api.planning.plan`.
    """
    module, _, name = function.rpartition(".")
    path = PACKAGE.joinpath(*module.split(".")).with_suffix(".py")
    tree = ast.parse(path.read_text("utf-8"))
    (node,) = (n for n in tree.body if isinstance(n, ast.FunctionDef) and n.name == name)
    section = (ast.get_docstring(node) or "").partition("\nArgs:\n")[2].partition("\n\n")[0]
    said = {name: " ".join(text.split()) for name, text in ARGUMENT.findall(section)}
    given = node.args
    arguments = [*([given.vararg] if given.vararg else []), *given.args, *given.kwonlyargs]
    missing = [None] * (len(given.args) + bool(given.vararg) - len(given.defaults))
    return [
        Parameter(
            argument.arg,
            ast.unparse(argument.annotation) if argument.annotation else "str",
            None if default is None else ast.literal_eval(default),
            default is None,
            number == 0,
            said.get(argument.arg, ""),
        )
        for number, (argument, default) in enumerate(
            zip(arguments, [*missing, *given.defaults, *given.kw_defaults], strict=True)
        )
        if argument.arg != "progress"
    ]


def add_options(
    p: argparse.ArgumentParser, function: str | None, own: Mapping[str, Mapping[str, Any]]
) -> None:
    """Give a command the options of a function.

    Args:
        p: the command's parser.
        function: see `parameters`; None for a command that only has its own options.
        own: rows of the command that differ from the function's, or that the function lacks, by
            name.
    """
    rows = {one.name: _row(one) for one in (parameters(function) if function else [])}
    for name, row in own.items():
        rows[name] = {**rows.get(name, {}), **row}
    flags = {
        name: str(row.get("flag", f"--{name.replace('_', '-')}")) for name, row in rows.items()
    }

    def flag(match: re.Match[str]) -> str:
        return flags.get(match[1], match[1])

    for name, row in rows.items():
        keywords = {key: value for key, value in row.items() if key not in ("flag", "first")}
        keywords["help"] = re.sub("`(.+?)`", flag, row["help"])
        if row.get("first"):
            p.add_argument(name, **keywords)
        else:
            p.add_argument(flags[name], dest=name, **keywords)


def _row(one: Parameter) -> dict[str, Any]:
    """Arguments of `add_argument`; and the `flag`, or `first` where it stands without one."""
    row: dict[str, Any] = {"help": one.said.removesuffix(".").replace('"', "").replace("%", "%%")}
    row |= next((found for word, found in BY_TYPE if word in one.annotation), {})
    if one.annotation.startswith("Literal["):
        row["metavar"] = "|".join(re.findall("'(.+?)'", one.annotation))
    if one.first and one.required:
        row["first"] = True
    elif one.required:
        row["required"] = True
    else:
        row["default"] = one.default
        if isinstance(one.default, str | float) or type(one.default) is int:
            shown = f"{one.default:g}" if isinstance(one.default, float) else one.default
            row["help"] += f" (default: {shown})"
    return row | ROWS.get(one.name, {})


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
