"""Counts, from the test run itself, of what the reliability table reports.

Tests call `count` after what they count was checked; the hooks in `conftest.py` collect the counts of
all tests, over all processes, and the examples that Hypothesis ran. `pytest --reliability=FILE` writes
the table.
"""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Iterable
from pathlib import Path

BAD_INPUTS = "bad inputs tried, each answered by one message"
FAULTS = "faults injected and survived"
SOLVED = "random scenarios solved and verified"
REFUSED = "random scenarios refused: infeasible, with the least violation"
BARRED = "random scenarios refused: no window, or a burn against a rule"
REFINED = "random scenarios not verified between coarse nodes, and ended as above on a finer grid"
WRONG = "random scenarios ended in anything else"
PROPERTIES, EXAMPLES = "property tests that passed", "examples that they ran"
FAILED = "property tests that failed (must be 0); their examples are not counted"

ORDER = (
    *(PROPERTIES, EXAMPLES, FAILED, BAD_INPUTS, FAULTS),
    *(SOLVED, REFUSED, BARRED, REFINED, WRONG),
)

COUNTS: Counter[str] = Counter()
"""Of the test that runs at the moment."""


def count(what: str) -> None:
    """One more of something."""
    COUNTS[what] += 1


def examples(statistics: str) -> int:
    """Examples that passed, from what Hypothesis says of a test."""
    return sum(int(number) for number in re.findall(r"(\d+) passing", statistics))


def table(totals: Counter[str]) -> str:
    """Markdown, in a fixed order."""
    rows = [f"| {name} | {totals[name]:,} |" for name in ORDER]
    return "\n".join(["| figure | count |", "|---|---|", *rows]) + "\n"


def write(path: Path, totals: Counter[str], profile: str, outcome: Iterable[str]) -> None:
    """The table with what it was made from."""
    path.parent.mkdir(parents=True, exist_ok=True)
    head = f"Hypothesis profile `{profile}`; {', '.join(outcome)}.\n\n"
    path.write_text(head + table(totals), encoding="utf-8")
