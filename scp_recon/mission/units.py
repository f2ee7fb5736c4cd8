"""Units of the nondimensional problem."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

Array = npt.NDArray[np.float64]


@dataclass(frozen=True)
class Units:
    """Units of the nondimensional problem: an initial radius, and the time that makes GM one."""

    length_m: float
    time_s: float

    @classmethod
    def of_orbit(cls, state: Array, gm: float) -> Units:
        """For a flight that starts at a state, shape (6,)."""
        length = float(np.linalg.norm(state[:3]))
        return cls(length, float(np.sqrt(length**3 / gm)))

    @property
    def speed_m_s(self) -> float:
        """Unit of velocity."""
        return self.length_m / self.time_s

    @property
    def state(self) -> Array:
        """Units of a state's six components."""
        return np.repeat([self.length_m, self.speed_m_s], 3)
