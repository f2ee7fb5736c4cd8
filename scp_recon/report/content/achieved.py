"""The probability that sampled flights achieve over time, and what was asked."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from scp_recon.monte_carlo.estimates import proportion
from scp_recon.monte_carlo.observation_time import joint_margins
from scp_recon.monte_carlo.whole_flight import SAFETY
from scp_recon.report.content.flown import Flown
from scp_recon.report.content.subject import Subject
from scp_recon.verification.probabilities import holds

Array = npt.NDArray[np.float64]
Bools = npt.NDArray[np.bool_]

SO_FAR = "all of them, from the start so far"
"""Share of the flights that have broken nothing yet."""


@dataclass(frozen=True, eq=False)
class Achieved:
    """A probability over time with its 95 % interval, shape (n,) each."""

    name: str
    times_s: Array
    value: Array
    low: Array
    high: Array

    @property
    def worst(self) -> int:
        """Where it is lowest."""
        return int(np.argmin(self.value))


def achieved(subject: Subject, flown: Flown) -> list[Achieved]:
    """Of every joint constraint at each time, and of all of them from the start so far."""
    mission = subject.mission
    seen = flown.window
    joint = joint_margins(mission, flown.window_s, flown.positions[seen]) if len(seen) else {}
    radius = np.linalg.norm(flown.positions, axis=2) - mission.scenario.safety.radius_min_m
    kept: dict[str, tuple[Array, Bools]] = {SAFETY: (flown.times_s, holds(radius, "m"))}
    for name, margin in joint.items():
        kept[name] = flown.window_s, holds(margin, "m" if name == "site_distance" else "rad")
    still = np.ones((len(flown.times_s), flown.samples), dtype=bool)
    for times, held in kept.values():
        still[np.isin(flown.times_s, times)] &= held
    unbroken = np.logical_and.accumulate(still, axis=0)
    found = [_estimated(name, times, held) for name, (times, held) in kept.items()]
    return [*found, _estimated(SO_FAR, flown.times_s, unbroken)]


def _estimated(name: str, times: Array, held: Bools) -> Achieved:
    estimates = [proportion(int(count), held.shape[1]) for count in held.sum(axis=1)]
    value, low, high = np.array(estimates).T
    return Achieved(name, times, value, low, high)
