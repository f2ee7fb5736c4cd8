"""Where a plan leads by some time, and how well that is known: its own burns flown, linear spread.

The plan's nodes say it, up to the last one before that time. Where burns were measured the flight is
flown again from the first of them. A measured burn adds no error, and what it tells of errors that all
burns share is not used: the others err as before.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from scp_recon.in_flight.parent import FlownPlan
from scp_recon.mission.grid import RK4_STEP_MAX_S
from scp_recon.mission.uncertainty import execution_errors
from scp_recon.physics.flow import differentiate
from scp_recon.physics.forces import ForceModel

Array = npt.NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Prediction:
    """A state and its spread, J2000, m and m/s.

    Attributes:
        state: shape (6,).
        factor: S with S S' its covariance, shape (6, c).
    """

    state: Array
    factor: Array

    @property
    def covariance(self) -> Array:
        """Shape (6, 6)."""
        return self.factor @ self.factor.T

    def carried(self, duration_s: float, forces: ForceModel) -> Prediction:
        """After a coast."""
        state, factor = self.state, self.factor
        steps = int(np.ceil(duration_s / RK4_STEP_MAX_S))
        for _ in range(steps):
            arc = differentiate(state[None], np.array([duration_s / steps]), forces)
            state, factor = arc.state[0], arc.stm[0] @ factor
        return Prediction(state, factor)

    def burnt(self, burn: Array, errors: Array, columns: npt.NDArray[np.intp]) -> Prediction:
        """After a burn in m/s, shape (3,), whose errors (3, k) go into those columns of the factor."""
        factor = self.factor.copy()
        factor[3:, columns] += errors
        return Prediction(self.state + np.r_[np.zeros(3), burn], factor)


def predict(flown: FlownPlan, at_s: float, measured: Mapping[int, Array]) -> Prediction:
    """What a plan predicts for a time, after a burn there.

    Args:
        flown: the plan.
        at_s: not before its first node, s.
        measured: burns as they were, by their number in the flight from 1, m/s, shape (3,).
    """
    scenario, forces, times = flown.mission.scenario, flown.mission.forces, flown.times_s
    first = scenario.burns_flown + 1
    burns = [(t, i) for i, t in enumerate(scenario.burn_times_s) if t <= at_s]
    again = [(t, i) for t, i in burns if i + first in measured]
    node = int(np.searchsorted(times, again[0][0] if again else at_s, side="right")) - 1
    now, found = times[node], Prediction(flown.states[node], flown.factors[node])
    if again:
        errors, i = execution_errors(scenario).columns(flown.burns_m_s), again[0][1]
        took = measured[i + first] - flown.burns_m_s[i]
        found = found.burnt(took, -errors[i], flown.columns_of(i))
        for time, i in burns:
            if time > now:
                known = measured.get(i + first)
                burn = flown.burns_m_s[i] if known is None else known
                kept = errors[i] if known is None else 0.0 * errors[i]
                found = found.carried(time - now, forces).burnt(burn, kept, flown.columns_of(i))
                now = time
    return found.carried(at_s - now, forces)
