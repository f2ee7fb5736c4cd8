"""Whether a probability can be told from what its estimate errs by."""

from __future__ import annotations

from collections.abc import Iterator

from formulations.rows.flight_probability import PROBABILITY_MAX
from scp_recon.errors import InputError
from scp_recon.mission.checks.given import Given
from scp_recon.scenario.warning import ScenarioWarning


def of_flights(given: Given) -> Iterator[ScenarioWarning]:
    """Directions of whole flights tell a probability up to `PROBABILITY_MAX`.

    Raises:
        InputError: if more is asked.
    """
    risk = given.scenario.risk
    if risk.scope == "flight" and risk.p_chance > PROBABILITY_MAX:
        raise InputError(
            "risk.p_chance",
            f"1 - {1.0 - risk.p_chance:.3g}",
            f'must be at most 1 - {1.0 - PROBABILITY_MAX:.0e} with risk.scope = "flight": '
            "beyond it the estimate errs by as much as is left",
        )
    yield from ()
