"""Units of the nondimensional problem, and the grid of its nodes."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from formulations.arrays import Array


@dataclass(frozen=True)
class Units:
    """Units of the nondimensional problem.

    Attributes:
        length_m: the initial radius.
        time_s: the time that makes GM one.
    """

    length_m: float
    time_s: float

    @classmethod
    def of_orbit(cls, state: Array, gm: float) -> Units:
        """Units for a flight that starts at a state, shape (6,), with GM `gm`; SI."""
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

    def tolerance(self, figure: float, unit: str) -> float:
        """A tolerance in "m" or "m/s", as large beside the units as a figure is in the default mission.

        Tolerances in other units, angles and shares, are the figure.
        """
        scale = {
            "m": self.length_m / DEFAULT.length_m,
            "m/s": self.speed_m_s / DEFAULT.speed_m_s,
        }
        return figure * scale.get(unit, 1.0)


DEFAULT = Units(1171.3081106182094, 18127.26687986026)
"""Units of the packaged scenario recon_b, for which tolerances in m and m/s are given."""

RK4_STEP_MAX_S = 240.0
"""Keeps the planner within a millimetre of an adaptive integration over the default flight."""

NODES_MAX = 3000
"""Beyond them a plan would take minutes and gigabytes."""


def make_grid(fixed_s: Sequence[float], step_max_s: float) -> Array:
    """Ascending node times, s: `fixed_s`, and between them even steps of at most `step_max_s`."""
    fixed = np.unique(fixed_s)
    parts = [
        np.linspace(a, b, max(1, int(np.ceil((b - a) / step_max_s - 1e-9))) + 1)[:-1]
        for a, b in itertools.pairwise(fixed)
    ]
    return np.concatenate([*parts, fixed[-1:]])
