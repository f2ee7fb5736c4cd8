"""Sampled flights of a plan, as the report's bands and probabilities need them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from scp_recon.monte_carlo.sampling import BLOCK, fly_block
from scp_recon.report.content.subject import Subject
from scp_recon.verification.probabilities import SAMPLES, SEED

Array = npt.NDArray[np.float64]

LOOKS_IN_WINDOW = 121


@dataclass(frozen=True, eq=False)
class Flown:
    """Flights with the planner's dynamics: the very draws of the verification.

    Attributes:
        times_s: nodes, and even times in the window, shape (n,).
        window: which of them are in what is left of the window, shape (w,).
        positions: J2000, m, shape (n, flights, 3).
        executed_m_s: sizes of the burns as executed, shape (flights, m).
    """

    times_s: Array
    window: npt.NDArray[np.intp]
    positions: Array
    executed_m_s: Array

    @property
    def window_s(self) -> Array:
        """Times in the window, shape (w,)."""
        return self.times_s[self.window]

    @property
    def samples(self) -> int:
        """How many flights."""
        return len(self.executed_m_s)


def fly(subject: Subject, samples: int = SAMPLES, seed: int = SEED) -> Flown:
    """Fly a plan.

    Args:
        subject: the plan.
        samples: flights.
        seed: of all draws.
    """
    mission, burns = subject.mission, subject.solution.burns_m_s
    first, last = subject.window_s
    times = np.union1d(mission.times_s, subject.looks_s(LOOKS_IN_WINDOW))
    positions, executed = [], []
    for number in range(-(-samples // BLOCK)):
        flights = min(BLOCK, samples - number * BLOCK)
        block = fly_block(mission, burns, times, number, flights=flights, seed=seed)
        positions.append(block.states[..., :3])
        executed.append(np.linalg.norm(block.burns_m_s, axis=2))
    window = np.flatnonzero((times >= first) & (times <= last))
    return Flown(times, window, np.concatenate(positions, axis=1), np.concatenate(executed))
