"""Read a state that orbit determination delivers in flight, and check it against the plan flown."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from contextlib import suppress
from dataclasses import dataclass, field
from numbers import Real

import numpy as np
import numpy.typing as npt
from scipy.special import chdtrc, chdtri  # of chi-squared; scipy.stats takes half a second

from formulations.arrays import Array
from scp_recon.display import digits
from scp_recon.errors import InputError, one_of, option, shortened, whole_number
from scp_recon.replanning.flown import Prediction
from scp_recon.scenario.fields import ScenarioWarning
from scp_recon.scenario.schema import Scenario

UNITS_RATIO_MAX = 30.0
"""Of distances or speeds: kilometres are a thousand metres, and no flight errs by the root of that."""
UNLIKELY = 1e-4
"""Probability of a state as far from the prediction, below which it hardly is that of this flight."""
SURE_SIGMAS = 5.0
"""Multiple of a burn's errors beyond which a measurement is unlikely to be of the planned burn."""
LEAST_SPREAD = 1e-6
"""In units of length and speed, added to every spread: a millimetre is no contradiction."""

FRAMES = ("j2000", "sun_north")
MEASURED = option("measured_burns")
WORDS = {
    (6,): "six numbers, m and m/s",
    (3,): "three numbers, m/s",
    (6, 6): "six rows of six numbers",
}


def numbers(entry: str, given: npt.ArrayLike, shape: tuple[int, ...]) -> Array:
    """An array of finite numbers.

    Raises:
        InputError: if it is not numeric, not finite, or of another shape.
    """
    try:
        array = np.asarray(given, dtype=float)
    except (TypeError, ValueError):
        array = np.full(0, np.nan)
    if array.shape != shape or not np.isfinite(array).all():
        words = " ".join(shortened(given).replace("\\n", " ").split())
        raise InputError(entry, words, f"must be {WORDS[shape]}, all finite")
    return array


def _time(entry: str, given: object) -> float:
    """Check that a time is a finite number of any type."""
    if isinstance(given, Real) and not isinstance(given, bool):
        with suppress(OverflowError):
            if np.isfinite(time := float(given)):
                return time
    raise InputError(entry, shortened(given), "must be a time past the epoch, s")


@dataclass(frozen=True, eq=False)
class Delivery:
    """A state in flight, as it was delivered.

    Attributes:
        at_s: time past the plan's epoch, s; burns at or before it are flown.
        state: state after these burns, m and m/s, body-centred, shape (6,).
        frame: axes of state and measured burns, at the epoch.
        covariance: m and m/s, shape (6, 6); the scenario's initial one if there is none.
        covariance_frame: its axes.
        measured: flown burns as telemetry saw them, m/s, shape (3,), by their number in the flight
            from 1.
    """

    at_s: float
    state: Array
    frame: str = "j2000"
    covariance: Array | None = None
    covariance_frame: str = "j2000"
    measured: Mapping[int, Array] = field(default_factory=dict)

    @classmethod
    def of(
        cls,
        at_s: float,
        state: npt.ArrayLike,
        *,
        frame: str = "j2000",
        covariance: npt.ArrayLike | None = None,
        covariance_frame: str | None = None,
        measured: Mapping[int, npt.ArrayLike] | None = None,
    ) -> Delivery:
        """Make a delivery from a user's values, each of them checked; see the attributes.

        Raises:
            InputError: naming the entry, what was given and what is allowed.
        """
        burns = {} if measured is None else measured
        if not isinstance(burns, Mapping):
            raise InputError(MEASURED, shortened(burns), "must be a table of burns by number")
        if covariance_frame is not None and covariance is None:
            raise InputError(option("covariance_frame"), covariance_frame, "goes with a covariance")
        axes = frame if covariance_frame is None else covariance_frame
        matrix = None if covariance is None else numbers(option("covariance"), covariance, (6, 6))
        return cls(
            at_s=_time(option("at_s"), at_s),
            state=numbers(option("state"), state, (6,)),
            frame=one_of(option("frame"), frame, FRAMES),
            covariance=matrix,
            covariance_frame=one_of(option("covariance_frame"), axes, (*FRAMES, "rtn")),
            measured={
                whole_number(MEASURED, n, 1, 64): numbers(MEASURED, burn, (3,))
                for n, burn in burns.items()
            },
        )

    def burns_flown(self, scenario: Scenario, planned: Array) -> list[list[float]]:
        """Every burn of the flight so far, m/s: measured, or as planned, of a plan's burns (m, 3).

        Raises:
            InputError: if a burn was measured that has not been flown.
        """
        before = [] if scenario.in_flight is None else list(scenario.in_flight.flown_m_s)
        ahead = zip(scenario.burn_times_s, planned.tolist(), strict=True)
        flown = [*before, *(burn for time, burn in ahead if time <= self.at_s)]
        for number, burn in self.measured.items():
            if number > len(flown):
                allowed = f"must be one of those flown by {self.at_s:g} s, 1 to {len(flown)}"
                raise InputError(MEASURED, f"burn {number}", allowed)
            flown[number - 1] = burn.tolist()
        return [list(burn) for burn in flown]

    def strange_burns(
        self, scenario: Scenario, planned: Array, kicks: Array
    ) -> Iterator[ScenarioWarning]:
        """Measured burns that are far from those of the plan that is flown, shape (m, 3), m/s.

        `kicks` are the factors of their covariances, corrections included, shape (m, 3, c).

        Raises:
            InputError: if one is no burn of this flight in metres per second.
        """
        first = scenario.burns_flown + 1
        for number, burn in sorted(self.measured.items()):
            if not 0 <= number - first < len(planned):
                continue
            expected = planned[number - first]
            sigma = float(np.linalg.norm(kicks[number - first]))
            off = float(np.linalg.norm(burn - expected))
            size, planned_size = float(np.linalg.norm(burn)), float(np.linalg.norm(expected))
            if size > max(UNITS_RATIO_MAX * planned_size, scenario.burns.dv_max_m_s):
                raise InputError(
                    MEASURED,
                    f"burn {number} of {digits(size, 4)}",
                    f"must be in m/s: the plan has {digits(planned_size, 4)} m/s then",
                )
            if off > SURE_SIGMAS * sigma and off > 0.0:
                yield ScenarioWarning.of(
                    "measured_burns",
                    f"burn {number} {digits(1e3 * off, 3)} mm/s from the one planned",
                    f"expected at most {1e3 * SURE_SIGMAS * sigma:.3g} mm/s, {SURE_SIGMAS:g} sigma of "
                    "its errors: check unit and frame",
                )

    def strange_state(
        self, state: Array, factor: Array, predicted: Prediction, units: Array
    ) -> Iterator[ScenarioWarning]:
        """Compare the state with the prediction of the plan in flight for the same time.

        The state (6,), m and m/s, and the factor (6, 6) of its covariance are in J2000; units (6,) are
        those of length and speed.

        Raises:
            InputError: if it is not in metres and seconds.
        """
        spread = (factor @ factor.T + predicted.covariance) / np.outer(units, units)
        spread += LEAST_SPREAD**2 * np.eye(6)
        off = (state - predicted.state) / units
        for part, noun, unit_name in (
            (slice(3), "position", "m"),
            (slice(3, 6), "velocity", "m/s"),
        ):
            given, expected = (float(np.linalg.norm(s[part])) for s in (state, predicted.state))
            low, high = sorted((given, expected))
            sigma = float(np.sqrt(np.trace(spread[part, part])))
            if high > UNITS_RATIO_MAX * low and np.linalg.norm(off[part]) > SURE_SIGMAS * sigma:
                raise InputError(
                    option("state"),
                    f"a {noun} of {digits(given, 4)}",
                    f"must be in {unit_name}: the plan has {digits(expected, 4)} {unit_name} then",
                )
        distance2 = float(off @ np.linalg.solve(spread, off))
        if chdtrc(6, distance2) < UNLIKELY:
            position, velocity = np.linalg.norm((state - predicted.state).reshape(2, 3), axis=1)
            yield ScenarioWarning.of(
                "state",
                f"{digits(position, 4)} m and {digits(1e3 * velocity, 3)} mm/s from what the plan "
                f"predicts at {self.at_s:g} s",
                f"{np.sqrt(distance2):.1f} sigma, expected at most {np.sqrt(chdtri(6, UNLIKELY)):.1f}: "
                "check units, frame and the burns flown",
            )
