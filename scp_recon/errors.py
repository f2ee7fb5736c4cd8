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
        super().__init__(f"{entry}: got {given}; {allowed}")
        self.entry, self.given, self.allowed = entry, given, allowed
