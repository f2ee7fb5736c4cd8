"""What can go wrong with what the user gave, and checks that say so."""

from __future__ import annotations

from collections.abc import Collection, Iterator
from contextlib import contextmanager
from numbers import Integral


class InputError(ValueError):
    """An entry of the input is unusable; the message names it, what was given and what is allowed.

    Args:
        entry: dotted path of the entry, or the file or option.
        given: what was found there.
        allowed: what would have been accepted.
    """

    def __init__(self, entry: str, given: str, allowed: str) -> None:
        self.entry, self.given, self.allowed = map(printable, (entry, given, allowed))
        super().__init__(f"{self.entry}: got {self.given}; {self.allowed}")


def printable(text: str) -> str:
    """What a file holds, or is called, goes to the terminal as text and not as a control sequence."""
    return "".join(c if c.isprintable() or c == "\n" else repr(c)[1:-1] for c in text)


def one_of(entry: str, given: object, known: Collection[str]) -> str:
    """A name that is known.

    Raises:
        InputError: if it is not.
    """
    if not isinstance(given, str) or given not in known:
        raise InputError(entry, shortened(given), f"must be one of {', '.join(known)}")
    return given


def whole_number(entry: str, given: object, low: int, high: int) -> int:
    """A whole number within bounds.

    Raises:
        InputError: if it is none, or beyond them.
    """
    if isinstance(given, Integral) and not isinstance(given, bool) and low <= int(given) <= high:
        return int(given)
    raise InputError(entry, shortened(given), f"must be a whole number from {low} to {high}")


@contextmanager
def needing(entry: str, extra: str, *packages: str) -> Iterator[None]:
    """Around imports that need an extra.

    Args:
        entry: what a message names.
        extra: its name.
        packages: those that may be missing; any, if none are given.

    Raises:
        InputError: if one is not installed.
    """
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


def shortened(given: object) -> str:
    """What was given, on a part of a line."""
    text = repr(given)
    return text if len(text) <= 80 else f"{text[:77]}..."
