"""Decide whether flights keep the limits on their position, at given times and between them.

One rule serves certification, verification and every count of flights: a flight keeps a limit whose
margin is not negative. Flights that are certain (`is_certain`) have one path, and are judged like the
plan's mean, which may violate a limit between nodes by `MEAN_TOLERANCE`.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np
import numpy.typing as npt

from formulations.arrays import Array, Booleans, Indices
from scp_recon.mission.constraints import COMPANION, SAFETY, safety_margins
from scp_recon.mission.mission import Mission
from scp_recon.mission.scene import errors_of_kind
from scp_recon.monte_carlo.observation_time import ALL, SCIENCE, joint_margins
from scp_recon.planning.initial_guess import from_burns

Counts = npt.NDArray[np.int64]

EVERYWHERE = SAFETY, COMPANION
"""Joint constraints that count throughout the flight; all others count in the window."""
OUTSIDE = 1e-3
"""Margin a second outside the flight's own window: only its sign counts."""
PARTS = 30
"""Of the time between two samples of a history: a second each."""
MEAN_TOLERANCE = {"m": 0.5, "rad": 1e-3}
"""Amount by which the mean may violate a limit between nodes, where it binds at nodes; at the default
mission's scale."""


def is_certain(mission: Mission, burns_m_s: Array, errors: str | None = None) -> bool:
    """Whether flights spread by less than the mean's tolerance all the way, by the linearised flow.

    Corrections, which narrow the spread, are left out. Nothing that flights can show tells one such
    flight from another, so that probabilities are 1 or 0, by the one path that all fly.

    Args:
        mission: that is flown.
        burns_m_s: planned, J2000, shape (m, 3).
        errors: of the burns; the scenario's if None.
    """
    if mission.uncertain.count:  # a site or a pole that is uncertain spreads no path
        return False
    model = errors_of_kind(mission.scenario, errors).in_units(mission.units.speed_m_s)
    problem = replace(mission.problem.open_loop, execution_errors=model)
    lin = mission.dynamics.linearise(problem, from_burns(mission, burns_m_s))
    widest = np.linalg.norm(lin.factor[:, :3], ord=2, axis=(1, 2)).max()
    return bool(widest * mission.units.length_m < allowed(mission, SAFETY))


def limit_margins(
    mission: Mission,
    times_s: Array,
    position: Array,
    observed: Indices | Booleans | slice,
    everywhere: Indices | slice = slice(None),
    *,
    certain: bool = False,
) -> dict[str, tuple[Array, Array]]:
    """Times at which each joint constraint counts, s, shape (k,), and its margins, shape (k, flights).

    Args:
        mission: that is flown.
        times_s: ascending, shape (n,).
        position: J2000, m, shape (n, flights, 3).
        observed: which times count for the limits of the observation.
        everywhere: which times count for safety distances.
        certain: whether the flights are; the mean's tolerance is then added.
    """
    clear = safety_margins(mission.scene, times_s[everywhere], position[everywhere])
    found = {name: (times_s[everywhere], margin) for name, margin in clear.items()}
    if len(window := times_s[observed]):
        seen = joint_margins(mission, window, position[observed])
        found |= {name: (window, in_own_window(mission, window, m)) for name, m in seen.items()}
    if certain:
        found = {
            name: (at, margin + allowed(mission, name)) for name, (at, margin) in found.items()
        }
    return found


def in_own_window(mission: Mission, times_s: Array, margin: Array) -> Array:
    """Margins (k,) or (k, flights), positive outside each flight's own window where edges move."""
    if mission.deviation is None or mission.edges.sigmas_s is None:
        return margin
    first, last = mission.own_edges_s
    time = times_s.reshape(-1, *[1] * (margin.ndim - 1))
    return np.maximum(margin, OUTSIDE * np.maximum(first - time, time - last))


def allowed(mission: Mission, name: str) -> float:
    """The mean's tolerance in a joint constraint of a mission, m or rad."""
    unit = "m" if name in (*EVERYWHERE, "site_distance") else "rad"
    return mission.units.tolerance(MEAN_TOLERANCE[unit], unit)


def limits_kept(margins: dict[str, tuple[Array, Array]]) -> dict[str, Booleans]:
    """Whether flights keep each joint constraint of `limit_margins`, and the observation's together."""
    kept = {name: np.asarray(margin >= 0.0) for name, (_, margin) in margins.items()}
    if kept.keys() >= set(SCIENCE):
        kept[ALL] = np.logical_and.reduce([kept[name] for name in SCIENCE])
    return kept


def every_second(times_s: Array) -> Array:
    """Sampled times (n,) and the seconds between, ascending, s, shape (PARTS (n - 1) + 1,)."""
    parts = times_s[:-1, None] + np.diff(times_s)[:, None] * (np.arange(PARTS) / PARTS)
    return np.append(parts.ravel(), times_s[-1])


@dataclass(frozen=True)
class LimitHistory:
    """Whether flights keep one joint constraint at some times, and every second between if uncertain.

    Attributes:
        name: of the constraint.
        times_s: at which it is sampled, s, shape (n,).
        holds: whether a flight keeps it at each time, shape (n, flights).
        arc: number of the time before each uncertain interval, shape (m,); none by default.
        flight: flight of each uncertain interval, shape (m,).
        between: whether the flight keeps the constraint at the seconds between, shape (m, PARTS - 1);
            None if the constraint counts at `times_s` alone.
    """

    name: str
    times_s: Array
    holds: Booleans
    arc: Indices = field(default_factory=lambda: np.zeros(0, np.intp))
    flight: Indices = field(default_factory=lambda: np.zeros(0, np.intp))
    between: Booleans | None = None

    @property
    def counts(self) -> Counts:
        """Flights that keep it at each time or, with `between`, each of `every_second`, (times,)."""
        at_times = self.holds.sum(axis=1)
        if self.between is None:
            return np.asarray(at_times)
        throughout = self._throughout
        counts = throughout.sum(axis=1) - np.bincount(
            self.arc[throughout[self.arc, self.flight]], minlength=len(throughout)
        )
        counts = np.repeat(counts[:, None], PARTS, axis=1)
        counts[:, 0] = at_times[:-1]
        np.add.at(counts[:, 1:], self.arc, self.between)
        return np.append(counts, at_times[-1])

    @property
    def kept(self) -> Booleans:
        """Flights that keep it whenever it counts, shape (flights,)."""
        kept = np.asarray(self.holds.all(axis=0))
        if self.between is not None:
            kept[self.flight[~self.between.all(axis=1)]] = False
        return kept

    @property
    def broken(self) -> tuple[Array, Indices]:
        """Times at which flights break it, s, and these flights, in pairs."""
        assert self.between is not None
        (sample, who), (row, part) = np.nonzero(~self.holds), np.nonzero(~self.between)
        step = np.diff(self.times_s)[self.arc[row]]
        time = self.times_s[self.arc[row]] + (part + 1) / PARTS * step
        return np.concatenate([self.times_s[sample], time]), np.concatenate([who, self.flight[row]])

    def fails(self, flights: Indices) -> Booleans:
        """Whether some flights break it at each time or, with `between`, each second: (times, some)."""
        if self.between is None:
            return np.asarray(~self.holds[:, flights])
        holds, column = self.holds[:, flights], np.full(self.holds.shape[1], -1)
        column[flights] = np.arange(len(flights))
        fails = np.repeat(~self._throughout[:, None, flights], PARTS, axis=1)
        fails[:, 0] = ~holds[:-1]
        mine = column[self.flight] >= 0
        fails[self.arc[mine], 1:, column[self.flight[mine]]] = ~self.between[mine]
        return np.concatenate([fails.reshape(len(fails) * PARTS, -1), ~holds[-1:]])

    @property
    def _throughout(self) -> Booleans:
        return self.holds[1:] & self.holds[:-1]
