"""Hypothesis profiles, chosen by `HYPOTHESIS_PROFILE`; counts of reliability.

`default` draws other examples in every run, `nightly` more of them; `ci` draws the same ones every
time, so that a change is judged by what it changes.
"""

import os
import signal
from collections import Counter
from collections.abc import Iterator
from pathlib import Path

import pytest
from hypothesis import Phase, settings

from tests import reliability

# A run in the background has it ignored, and so would have the processes that tests interrupt.
signal.signal(signal.SIGINT, signal.default_int_handler)

PROFILE = os.environ.get("HYPOTHESIS_PROFILE", "default")

settings.register_profile("default", max_examples=25, deadline=None, derandomize=False)
settings.register_profile("ci", max_examples=30, deadline=None, derandomize=True)
settings.register_profile("nightly", max_examples=500, deadline=None, derandomize=False)
# For mutation testing: fast and repeatable, and a failure needs no simple example.
settings.register_profile(
    "mutation",
    max_examples=20,
    deadline=None,
    derandomize=True,
    phases=[Phase.explicit, Phase.generate],
)
settings.load_profile(PROFILE)

COUNT = "count"
TOTALS: Counter[str] = Counter()
PASSED: set[str] = set()


def pytest_addoption(parser: pytest.Parser) -> None:
    parser.addoption(
        "--reliability", metavar="FILE", type=Path, help="write the counts of reliability"
    )


@pytest.hookimpl(wrapper=True)
def pytest_runtest_call(item: pytest.Item) -> Iterator[None]:
    """What a test counts goes with its report, which may be read in another process."""
    reliability.COUNTS.clear()
    try:
        return (yield)
    except pytest.skip.Exception:
        raise
    except BaseException:
        if getattr(getattr(item, "obj", None), "is_hypothesis_test", False):
            reliability.count(reliability.FAILED)
        raise
    finally:
        item.user_properties += [(COUNT, pair) for pair in reliability.COUNTS.items()]


def pytest_runtest_logreport(report: pytest.TestReport) -> None:
    if report.when == "call":
        for _, (name, times) in (pair for pair in report.user_properties if pair[0] == COUNT):
            TOTALS[name] += times
        if report.passed:
            PASSED.add(report.nodeid)
    # Left there at the very end by Hypothesis's own plugin.
    if report.nodeid in PASSED and (said := getattr(report, "_hypothesis_stats", "")):
        TOTALS[reliability.PROPERTIES] += 1
        TOTALS[reliability.EXAMPLES] += reliability.examples(said)


def pytest_terminal_summary(terminalreporter: pytest.TerminalReporter) -> None:
    path = terminalreporter.config.getoption("reliability")
    if path:
        reliability.write(path, TOTALS)
        terminalreporter.write_line(f"written: {path}")
