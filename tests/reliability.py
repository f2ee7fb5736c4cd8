"""Counts, from the test run itself, of what the reliability table reports.

Tests call `count` after what they count was checked; the hooks in `conftest.py` collect the counts of
all tests, over all processes, and the examples that Hypothesis ran. `pytest --reliability=FILE` writes
them.
"""

import json
import re
from collections import Counter
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
    COUNTS[what] += 1


def examples(statistics: str) -> int:
    """Examples that passed, from what Hypothesis says of a test."""
    return sum(int(number) for number in re.findall(r"(\d+) passing", statistics))


def write(path: Path, totals: Counter[str]) -> None:
    """The counts by figure, in a fixed order, as JSON."""
    path.parent.mkdir(parents=True, exist_ok=True)
    counts = {name: totals[name] for name in ORDER}
    path.write_text(json.dumps(counts, indent=1) + "\n", encoding="utf-8")
