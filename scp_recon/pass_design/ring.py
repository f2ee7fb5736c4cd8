"""The home orbit as a ring of states, in which a phase stands for a place and its velocity."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from scp_recon.scenario.home import HomeOrbit

Array = npt.NDArray[np.float64]

TURN = 2.0 * np.pi


@dataclass(frozen=True)
class Ring:
    """States by phase, whose waiting spacecraft may be at any of them at any time.

    Attributes:
        state: of a phase in [0, 2 pi), rad: position and velocity, J2000, body-centred, m and m/s,
            shape (6,).
    """

    state: Callable[[float], Array]

    def __call__(self, phase_rad: float) -> Array:
        """The state at a phase of any turn."""
        return self.state(float(np.mod(phase_rad, TURN)))


def home_ring(home: HomeOrbit, gm: float, axes: Array) -> Ring:
    """The home orbit of a scenario.

    Args:
        home: circle.
        gm: of the body, m^3/s^2.
        axes: from boundary.frame to J2000, shape (3, 3).
    """

    def state(phase: float) -> Array:
        position, velocity = home.state(phase, gm).reshape(2, 3)
        return np.concatenate([axes @ position, axes @ velocity])

    return Ring(state)
