"""Choose the tests of `make fast`: the cheapest first, as many as fit into its time.

`slow.txt` names the test functions that do not fit, by their seconds in a whole run on an idle machine;
`pytest --write-slow` writes it. A function counts with all its parameters; what a file's fixtures take
counts in equal parts for those of its functions that use what is made once for several tests. A
function that is not named is fast, and so is every new one.
"""

from collections import Counter
from collections.abc import Collection, Mapping
from pathlib import Path

SLOW = Path(__file__).with_name("slow.txt")
BUDGET_S = 75.0
"""Of both processes together; imports, collecting and first calls take the rest of a minute."""


def function_of(nodeid: str) -> str:
    """A test's function, without its parameters."""
    return nodeid.split("[")[0]


def slow_functions(
    calls: Mapping[str, float],
    fixtures: Mapping[str, float],
    sharing: Collection[str],
    budget_s: float = BUDGET_S,
) -> list[str]:
    """Functions that do not fit into the budget when the cheapest go first, sorted.

    Args:
        calls: seconds of each function, without fixtures.
        fixtures: seconds that the fixtures of each file took.
        sharing: functions that use fixtures of a wider scope than their own.
        budget_s: seconds that there are.
    """
    users = Counter(name.partition("::")[0] for name in sharing)
    seconds = dict(calls)
    for name in sharing:
        file = name.partition("::")[0]
        seconds[name] += fixtures.get(file, 0.0) / users[file]
    spent, slow = 0.0, []
    for name in sorted(seconds, key=seconds.__getitem__):
        spent += seconds[name]
        if spent > budget_s:
            slow.append(name)
    return sorted(slow)


def named_slow() -> frozenset[str]:
    """Functions that `make fast` leaves out."""
    return frozenset(SLOW.read_text(encoding="utf-8").split())
