"""Commands verify with few flights here: what is tested depends not on their number."""

import pytest


@pytest.fixture(autouse=True)
def _few(few_flights) -> None: ...
