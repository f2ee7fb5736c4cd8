"""What can go wrong with what the user gave."""

from __future__ import annotations


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
