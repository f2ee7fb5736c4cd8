"""What a check finds strange and cannot refuse; it goes with the plan, and every verdict tells it."""

from __future__ import annotations

from scp_recon.errors import printable
from scp_recon.scenario.fields import Line, Section


class ScenarioWarning(Section):
    """An entry that is hardly what was meant.

    Attributes:
        entry: dotted path of the entry.
        given: what was found there.
        expected: what would have raised no question, and why.
    """

    entry: Line
    given: Line
    expected: Line

    @classmethod
    def of(cls, entry: str, given: str, expected: str) -> ScenarioWarning:
        """From text that may hold what a user typed."""
        return cls(entry=entry, given=_line(given), expected=_line(expected))

    def __str__(self) -> str:
        """One line."""
        return f"{self.entry}: got {self.given}; {self.expected}"


def _line(text: str) -> str:
    return printable(text.replace("\n", " "))
