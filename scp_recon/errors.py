"""Report errors of the user's input; check numbers, names, paths and extras, or raise such an error."""

from __future__ import annotations

import difflib
import re
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from importlib import import_module
from numbers import Integral
from pathlib import Path
from typing import Any, NoReturn, TypeVar

OPTION = re.compile(r"\0(\w+)(?:=([^\0]*))?\0")
"""An option in a message, its name and a value's `repr`, between characters that no file's name has."""
ENTRY = re.compile(r"^(\w+(?:\.\w+)*)(?=: got )", re.MULTILINE)
"""An entry that begins another line of a message."""
ON_COMMAND_LINE = {"True": "yes", "False": "no"}
Value = TypeVar("Value")


def option(name: str, value: object = None) -> str:
    """Name an option in a message, in Python's form or in that of the command line.

    Args:
        name: of the parameter in Python, such as `facet_rounds`; shown as --facet-rounds on the
            command line.
        value: value to show, if any: `method='scp'`, or --method scp.
    """
    return f"\0{name}\0" if value is None else f"\0{name}={value!r}\0"


class InputError(ValueError):
    """An entry of the input is unusable; the message names it, what was given and what is allowed.

    Examples:
        >>> import scp_recon as sr
        >>> sr.load_scenario().replace({"grid.step_max_s": 0.0})
        Traceback (most recent call last):
        scp_recon.errors.InputError: grid.step_max_s: got 0.0; must be at least 1 and at most 1e+07

    Args:
        entry: dotted path of the entry, or the file or `option`.
        given: the value found.
        allowed: the values allowed.
        file: the scenario file that holds the entry; empty if no file does.
    """

    def __init__(self, entry: str, given: str, allowed: str, file: str = "") -> None:
        self._said = entry, given, allowed, file
        entry, allowed = (OPTION.sub(_in_python, text) for text in (entry, allowed))
        self.entry, self.given, self.allowed = map(printable, (entry, given, allowed))
        self.file = printable(file)
        where = f"{self.file}: " if file else ""
        super().__init__(f"{where}{self.entry}: got {self.given}; {self.allowed}")

    def __reduce__(self) -> tuple[type[InputError], tuple[str, str, str, str]]:
        """Pickle the error by its parts, so that it survives the way from another process."""
        return type(self), self._said

    def in_files(self, file_of: Callable[[str], str]) -> InputError:
        """The error with the file of each entry that it names; empty if no file holds the entry."""
        entry, given, allowed, _ = self._said
        file = file_of(entry)

        def named(match: re.Match[str]) -> str:
            other = file_of(match[1])
            return f"{other}: {match[0]}" if other and other != file else match[0]

        return InputError(entry, given, ENTRY.sub(named, allowed), file)

    def for_command(self, flags: Mapping[str, str]) -> InputError:
        """The error with options in the form of the command line.

        Args:
            flags: by the parameters' names, such as --facet-rounds.
        """
        entry, given, allowed, file = self._said

        def flag(match: re.Match[str]) -> str:
            name, value = match.groups()
            word = "" if value is None else " " + ON_COMMAND_LINE.get(value, value.strip("'"))
            return flags.get(name, name) + word

        of_option = OPTION.match(entry) is not None
        return InputError(
            OPTION.sub(flag, entry),
            ON_COMMAND_LINE.get(given, given) if of_option else given,
            OPTION.sub(flag, allowed),
            file,
        )


def _in_python(match: re.Match[str]) -> str:
    name, value = match.groups()
    return name if value is None else f"{name}={value}"


def printable(text: str) -> str:
    """Escape control characters of a text, so that the terminal shows them and does not obey."""
    return "".join(c if c.isprintable() or c == "\n" else repr(c)[1:-1] for c in text)


def one_of(entry: str, given: object, known: Collection[str]) -> str:
    """A name that is known; others are refused."""
    if not isinstance(given, str) or given not in known:
        raise InputError(entry, shortened(given), f"must be one of {', '.join(known)}")
    return given


class Named(dict[str, Value]):
    """Results by name; the error for an unknown name lists the nearest name and all names."""

    def __missing__(self, name: object) -> NoReturn:
        """Refuse it."""
        raise KeyError(unknown_name(name, self))


def unknown_name(name: object, known: Iterable[str]) -> str:
    """Message for an unknown name: the nearest known one, and all of them."""
    names = list(known)
    return f"{name!r}; {nearest(name, names)}there are {', '.join(names) or 'none'}"


def nearest(name: object, known: Sequence[str]) -> str:
    """Question whether the nearest known name is meant; empty if none is near."""
    near = difflib.get_close_matches(str(name), known, n=1)
    return f"did you mean {near[0]!r}? " if near else ""


def path_of(entry: str, given: object) -> Path:
    """Convert a path or a text to a path."""
    if not isinstance(given, str | Path):
        raise InputError(entry, shortened(given), "must be a path")
    return Path(given)


def only_with(needed: str, **given: object) -> None:
    """Refuse options that are given without what they need; None is not given."""
    for name, value in given.items():
        if value is not None:
            raise InputError(option(name), str(value), f"goes with {needed}")


EXACT = 2.0**53
"""Bound of whole numbers: a float above it need not be the one that was meant."""


def whole_number(entry: str, given: object, low: int, high: int) -> int:
    """Check a whole number within bounds, also given as 1e4, and return it."""
    if isinstance(given, float):
        whole = int(given) if abs(given) < EXACT and given.is_integer() else None
    else:
        whole = int(given) if isinstance(given, Integral) and not isinstance(given, bool) else None
    if whole is not None and low <= whole <= high:
        return whole
    raise InputError(entry, shortened(given), f"must be a whole number from {low} to {high}")


def make_whole(options: object, name: str, low: int, high: int, word: str = "") -> None:
    """Check an option of a frozen data class by `whole_number`, and keep it as an int.

    A message also names a `word` that is allowed in place of a number.
    """
    try:
        found = whole_number(option(name), getattr(options, name), low, high)
    except InputError as error:
        allowed = f"{error.allowed}, or {word}" if word else error.allowed
        raise InputError(option(name), error.given, allowed) from None
    object.__setattr__(options, name, found)


@contextmanager
def needing(entry: str, extra: str, *packages: str) -> Iterator[None]:
    """Context for imports that need an extra; of the packages that are named, or of any."""
    try:
        yield
    except ModuleNotFoundError as error:
        if packages and (error.name or "").split(".")[0] not in packages:
            raise
        raise InputError(
            entry,
            f"no module named {error.name}",
            f"needs the extra scp_recon[{extra}]: pip install 'scp_recon[{extra}]'",
        ) from None


def imported(entry: str, extra: str, *modules: str) -> Any:
    """Import modules that need an extra, and return the first."""
    with needing(entry, extra, *(name.partition(".")[0] for name in modules)):
        first, *_ = (import_module(name) for name in modules)
    return first


def shortened(given: object) -> str:
    """A given value, shortened to a part of a line."""
    text = repr(given)
    return text if len(text) <= 80 else f"{text[:77]}..."


def number_between(entry: str, given: object, low: float, high: float, unit: str = "") -> float:
    """Check a number within bounds, and return it; a message names the unit."""
    if isinstance(given, int | float) and not isinstance(given, bool) and low <= given <= high:
        return float(given)
    allowed = f"must be a number from {low:g} to {high:g} {unit}".rstrip()
    raise InputError(entry, shortened(given), allowed)


def version_of(package: str) -> str:
    """Version of an installed package; "unknown" if it is only on the path."""
    from importlib.metadata import PackageNotFoundError, version

    try:
        return version(package)
    except PackageNotFoundError:
        return "unknown"
