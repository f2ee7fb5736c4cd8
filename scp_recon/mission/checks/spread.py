"""Whether initial state and burns are known about as well as they are in flight: units, above all."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import numpy.typing as npt

from scp_recon.mission.checks.given import Given
from scp_recon.scenario.schema import Scenario
from scp_recon.scenario.warning import ScenarioWarning

Array = npt.NDArray[np.float64]

SPREAD = (1e-4, 0.0999)
"""1 sigma over distance or speed: 0.1 m at 1 km is the best that is flown. The ends are less than a
factor of 1000 apart, so that nothing between them is there in kilometres, or millimetres, too."""
SHARE_MAX = 0.3
"""Of a burn that errs, 1 sigma: beyond it a per cent was meant, or there is nothing to plan with."""
ERROR_MIN = 1e-3
"""Of every component of a burn, pointing included: no thruster is known to a tenth of a degree."""


def burn_errors(given: Given) -> Iterator[ScenarioWarning]:
    """Errors in proportion to a burn are shares of it."""
    uncertainty = given.scenario.uncertainty
    shares = {"execution_error": uncertainty.execution_error}
    if (gates := uncertainty.gates) is not None:
        for entry in ("magnitude_proportional", "magnitude_bias"):
            shares[f"gates.{entry}"] = getattr(gates, entry)
    for entry, share in shares.items():
        if share is not None and share > SHARE_MAX:
            yield ScenarioWarning.of(
                f"uncertainty.{entry}",
                f"{share:g} of a burn",
                f"at most {SHARE_MAX:g} would be no surprise: it is a share, not in per cent",
            )
    if 0.0 < (error := uncertainty.execution_error or 0.0) < ERROR_MIN:
        yield ScenarioWarning.of(
            "uncertainty.execution_error",
            f"{error:g} of a burn",
            f"0, or {ERROR_MIN:g} and more, would be no surprise: divided by a hundred once too often?",
        )


def check_spread(scenario: Scenario, state: Array, sigma: Array) -> Iterator[ScenarioWarning]:
    """Hold the largest sigmas against the distance from the centre and against the speed.

    A state that is known exactly raises no question.

    Args:
        scenario: gives the uncertainty.
        state: the initial one, J2000, m and m/s, shape (6,).
        sigma: of its components, shape (6,).
    """
    distance = float(np.linalg.norm(state[:3]))
    circular = float(np.sqrt(scenario.body.gm_m3_s2 / distance))
    speed = max(float(np.linalg.norm(state[3:])), circular)
    for key, unit_name, found, size, what in (
        ("position_m", "m", sigma[:3], distance, "of the distance from the centre"),
        ("velocity_m_s", "m/s", sigma[3:], speed, "of the speed, or of that of a circular orbit"),
    ):
        most, (low, high) = float(found.max()), SPREAD
        if most == 0.0 or low * size <= most <= high * size:
            continue
        yield ScenarioWarning.of(
            _entry(scenario, key),
            f"a 1-sigma error of {most:.3g} {unit_name}, {most / size:.2g} {what}",
            f"{low * size:.3g} to {high * size:.3g} {unit_name} would be no surprise; "
            "metres and seconds?",
        )


def _entry(scenario: Scenario, key: str) -> str:
    """Which entry says it."""
    given = scenario.uncertainty
    if scenario.in_flight is not None and scenario.in_flight.covariance is not None:
        return "in_flight.covariance"
    if given.initial_sigma_fraction is not None:
        return "uncertainty.initial_sigma_fraction"
    if given.initial_covariance is not None:
        return "uncertainty.initial_covariance"
    return f"uncertainty.initial_sigma_{key}"
