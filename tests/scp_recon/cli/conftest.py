"""Commands verify with few flights here, on which no test depends, for a terminal that is wide."""

import pytest


@pytest.fixture(autouse=True)
def _few(few_flights) -> None: ...


@pytest.fixture(autouse=True)
def _wide(monkeypatch) -> None:
    monkeypatch.setenv("COLUMNS", "200")
