"""The covariance of a flight by what burns add to it, in closed form: no factor, no columns.

    Sigma+ = Sigma + B Q(v) B',
    Q(v) = along^2 u u' + across^2 (I - u u')   (Gates),   beta^2 diag(v)^2   (componentwise)

A bias that burns share correlates with the state: c is its covariance with the state, and a burn adds
B b v c' + c (B b v)' + b^2 B v v' B' to Sigma, and B b v to c.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from formulations.problem.execution_errors import VANISHED
from scp_recon.mission.mission import Mission
from scp_recon.scenario.uncertainty import Gates

Array = npt.NDArray[np.float64]


@dataclass(frozen=True)
class Spread:
    """Covariance of the state (6, 6), and of the state with the bias over its sigma (6,); SI, J2000."""

    covariance: Array
    with_bias: Array

    @classmethod
    def before_burns(cls, mission: Mission) -> Spread:
        """Of the initial state."""
        return cls(mission.initial_factor @ mission.initial_factor.T, np.zeros(6))

    def after_burn(self, mission: Mission, burn: Array) -> Spread:
        """With the errors of a burn, m/s, shape (3,)."""
        uncertainty, covariance = mission.scenario.uncertainty, self.covariance.copy()
        if uncertainty.gates is None:
            assert uncertainty.execution_error is not None
            covariance[3:, 3:] += np.diag((uncertainty.execution_error * burn) ** 2)
            return Spread(covariance, self.with_bias)
        covariance[3:, 3:] += gates_covariance(uncertainty.gates, burn)
        bias = uncertainty.gates.magnitude_bias * np.concatenate([np.zeros(3), burn])
        cross = np.outer(bias, self.with_bias)
        covariance += cross + cross.T + np.outer(bias, bias)
        return Spread(covariance, self.with_bias + bias)

    def carried(self, stm: Array) -> Spread:
        """Over an arc with an STM (6, 6)."""
        return Spread(stm @ self.covariance @ stm.T, stm @ self.with_bias)


def gates_covariance(gates: Gates, burn: Array) -> Array:
    """Covariance Q of a burn, m/s, shape (3, 3), with the planner's bound below its fixed error."""
    size = float(np.linalg.norm(burn))
    if size == 0.0:
        return np.zeros((3, 3))
    fixed = np.array([gates.magnitude_fixed_m_s, gates.pointing_fixed_m_s])
    proportional = np.array([gates.magnitude_proportional, gates.pointing_proportional_rad])
    bound = float(fixed.max())
    if bound > 0.0:
        vanished = VANISHED * bound
        executed = 1.0 - (1.0 - min(size / vanished, 1.0) ** 2) ** 3
        x = np.clip((size**2 - vanished**2) / (bound**2 - vanished**2), 0.0, 1.0)
        direction = float(np.polyval([6.0, -15.0, 10.0, 0.0, 0.0, 0.0], x))
        fixed = np.sqrt(executed) * (bound - direction * (bound - fixed))
    along, across = fixed**2 + (proportional * size) ** 2
    unit = burn / size
    return across * np.eye(3) + (along - across) * np.outer(unit, unit)
