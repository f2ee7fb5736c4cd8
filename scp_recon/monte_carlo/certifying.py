"""What flights have to show before they certify a probability: how many, and which."""

from __future__ import annotations

import numpy as np

from scp_recon.errors import InputError
from scp_recon.monte_carlo.estimates import proportion

FLIGHTS_MIN, FAILURES, FLIGHTS_MAX = 10_000, 300, 1_000_000
"""At least so many flights, and so many that 300 may break what is allowed to break; and at most."""

FIRST_SEED = 1_000
"""Of the first round's flights; no other draws of this library begin there. Each round has the next."""


def flights_needed(asked: float, otherwise: str = "--certify no") -> int:
    """Flights whose failures tell the probability well enough.

    Args:
        asked: probability.
        otherwise: what messages say to those who can do without.

    Raises:
        InputError: if they are too many.
    """
    rounding = 1e-6  # of 1 - asked, in flights
    flights = int(np.ceil(max(FLIGHTS_MIN, FAILURES / (1.0 - asked) - rounding)))
    if flights > FLIGHTS_MAX:
        raise InputError(
            "risk.p_chance",
            f"{asked:.12g}",
            f"takes {flights} flights to certify, more than {FLIGHTS_MAX}: at most "
            f"{1.0 - FAILURES / FLIGHTS_MAX:g}, or {otherwise}",
        )
    return flights


def successes_needed(asked: float, samples: int) -> int:
    """The least number of successes whose lower limit is at least `asked`."""
    low, high = int(asked * samples), samples
    while low < high:
        middle = (low + high) // 2
        low, high = (
            (low, middle) if proportion(middle, samples).low >= asked else (middle + 1, high)
        )
    return low
