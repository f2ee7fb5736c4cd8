"""Commands verify with few flights here, on which no test depends, for a terminal that is wide.

What exact risk would save is planned by its own test alone.
"""

import pytest

from scp_recon.cli import plan_run


@pytest.fixture(autouse=True)
def _few(few_flights) -> None: ...


@pytest.fixture(autouse=True)
def _priced_once(monkeypatch) -> None:
    monkeypatch.setattr(plan_run, "cost_of_exact_risk", lambda *_: None)


@pytest.fixture(autouse=True)
def _wide(monkeypatch) -> None:
    monkeypatch.setenv("COLUMNS", "200")
