"""Fly a plan many times with errors, tallied block by block in constant memory."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import closing
from dataclasses import dataclass, field
from functools import partial

import numpy as np
import numpy.typing as npt

from formulations.arrays import Array
from scp_recon.jobs.job import Executor, Job, here, in_order
from scp_recon.jobs.processes import Limits
from scp_recon.mission.constraints import companion_distance_m
from scp_recon.mission.scene import errors_of_kind
from scp_recon.mission.windows import Window
from scp_recon.monte_carlo.estimates import Estimate, Tally, proportion
from scp_recon.monte_carlo.limits import EVERYWHERE, limit_margins, limits_kept
from scp_recon.monte_carlo.narrow import Narrowed, narrow
from scp_recon.monte_carlo.observation_time import ALL, SCIENCE, time_held
from scp_recon.monte_carlo.sampling import (
    BLOCK,
    Flyer,
    corrections_of,
    policy_kind,
)
from scp_recon.monte_carlo.whole_flight import SampledFlights

SAMPLES_MIN, SAMPLES_MAX, SEED_MAX = 20, 10**9, 2**63 - 1
"""Least number of flights: the normality test needs as many."""

SAMPLE_STEP_S = 60.0
"""Longest time between two samples in the window; crossings are then bisected."""

TIME_BIN_S, DISTANCE_BIN_M = 0.5, 0.1
DV_BIN = 1e-5
"""Of commanded delta-v, over the most that is expected."""
PLAIN = 10_000
"""Flights that are counted plainly before an interval's width asks for strata."""
LIMITS = Limits(seconds=3600.0)
"""Limits of a block, which takes a second or less: one that takes longer hangs."""
TERMINAL_KEPT = 5000
"""Final states kept for the normality test, whose distribution is tabulated up to this number."""


@dataclass(frozen=True, eq=False)
class FlightConfig(Flyer):
    """Planned burns to fly, and the seed of all draws.

    Raises:
        InputError: if truth or errors cannot be flown in this scenario.
    """

    seed: int = 0

    def __post_init__(self) -> None:
        """Refuse inputs that make flights impossible, and another body's gravity."""
        errors_of_kind(self.mission.scenario, self.errors)
        self.mission.gravity.in_words(self.truth)

    def __getstate__(self) -> dict[str, object]:
        """What a copy for another process takes along, with `certain`, which takes long to find."""
        _ = self.certain
        return vars(self)

    @property
    def window_samples_s(self) -> Array:
        """Times in the rest of the window, s, at most `SAMPLE_STEP_S` apart, with edges and nodes."""
        return self._samples(self.mission.observed_s)

    @property
    def watched_samples_s(self) -> Array:
        """The same of `watched_s`, in which the windows of flights lie."""
        whole = self._samples(self.mission.edges.watched_s), self.mission.edges.samples_s
        return np.union1d(self.window_samples_s, np.concatenate(whole))

    def _samples(self, span: Window | None) -> Array:
        if span is None:
            return np.zeros(0)
        first, last = span
        even = np.linspace(first, last, int(np.ceil((last - first) / SAMPLE_STEP_S)) + 1)
        nodes = self.mission.times_s
        return np.union1d(even, nodes[(nodes >= first) & (nodes <= last)])

    def counted_s(self, name: str) -> Array:
        """Times at which a joint constraint is counted, s: for safety distances all nodes."""
        return self.mission.times_s if name in EVERYWHERE else self.watched_samples_s


@dataclass(frozen=True, eq=False)
class FlightBlock:
    """Counts and sums of one block of flights."""

    held_s: dict[str, Array]
    entry: Array
    exit: Array
    node_counts: dict[str, npt.NDArray[np.int64]]
    whole: int
    closest_m: Array
    executed_dv_m_s: Array
    commanded_dv_m_s: Array
    limits: dict[str, npt.NDArray[np.int64]]
    terminal: Array
    failed: npt.NDArray[np.int64]


def run_block(config: FlightConfig, block: tuple[int, int]) -> FlightBlock:
    """Fly a block, given as (its number, its number of flights)."""
    number, flights = block
    mission, samples, watched = (
        config.mission,
        config.window_samples_s,
        config.watched_samples_s,
    )
    times = np.union1d(watched, mission.times_s)
    flown = config.fly_block(times, number, flights=flights, seed=config.seed)
    corrected = [one.burn for one in config.policy]
    of_burns = mission.problem.burn_margins(
        flown.commanded_m_s.swapaxes(0, 1) / mission.units.speed_m_s
    )
    observed, seen, nodes = (
        np.searchsorted(times, at) for at in (samples, watched, mission.times_s)
    )
    own = flown.mission
    held = time_held(own, samples, flown.states[observed]) if len(samples) else {}
    position, certain = flown.states[..., :3], config.certain
    holds = limits_kept(limit_margins(own, times, position, seen, nodes, certain=certain))
    nothing = np.zeros(0)
    scenario = mission.scenario
    whole = flown.closest_m >= scenario.safety.radius_min_m
    whole &= flown.apart_m >= companion_distance_m(scenario)
    for kept in holds.values():
        whole &= kept.all(axis=0)
    return FlightBlock(
        held_s={name: h.duration for name, h in held.items()},
        entry=held[ALL].entry if held else nothing,
        exit=held[ALL].exit if held else nothing,
        node_counts={name: h.sum(axis=1) for name, h in holds.items()},
        whole=int(whole.sum()),
        closest_m=flown.closest_m,
        executed_dv_m_s=np.linalg.norm(flown.burns_m_s, axis=2).sum(axis=1),
        commanded_dv_m_s=np.linalg.norm(flown.commanded_m_s, axis=2).sum(axis=1),
        limits={name: (margin[corrected] >= 0.0).sum(axis=1) for name, margin in of_burns.items()},
        terminal=flown.states[-1],
        failed=flown.failed.sum(axis=1),
    )


@dataclass(eq=False)
class FlightTally:
    """Running totals of the flights of a configuration.

    Attributes:
        held_s: seconds in which each observation constraint holds, and all at once.
        full: flights in which each holds throughout the window.
        entry, exit: first and last time at which all hold, of the flights in which they ever do.
        node_counts: flights in which each joint constraint holds, at the times of `counted_s`.
        whole: flights that keep every limit on the position at every sampled time.
        closest, executed_dv, commanded_dv: smallest distance from the body's centre, total delta-v.
        limits: flights in which each corrected burn keeps each limit on burns, shape (k,).
        failed: flights in which planning each burn again failed, shape (k,); empty without.
        terminal: final states of the first flights.
        narrowed: the joint constraints' probabilities, of flights in strata; None without such flights.
    """

    config: FlightConfig
    samples: int = 0
    held_s: dict[str, Tally] = field(init=False)
    full: dict[str, int] = field(init=False)
    entry: Tally = field(init=False)
    exit: Tally = field(init=False)
    node_counts: dict[str, npt.NDArray[np.int64]] = field(default_factory=dict)
    whole: int = 0
    closest: Tally = field(init=False)
    executed_dv: Tally = field(init=False)
    commanded_dv: Tally = field(init=False)
    limits: dict[str, npt.NDArray[np.int64]] = field(default_factory=dict)
    terminal: Array = field(default_factory=lambda: np.empty((0, 6)))
    terminal_sum: Array = field(default_factory=lambda: np.zeros(6))
    terminal_outer: Array = field(default_factory=lambda: np.zeros((6, 6)))
    narrowed: Narrowed | None = None
    failed: Array = field(init=False)

    def __post_init__(self) -> None:
        """Make empty tallies that span all values that can occur."""
        observed = self.config.mission.observed_s
        first, last = observed or self.config.mission.schedule.window_s
        planned = float(np.linalg.norm(self.config.burns_m_s, axis=1).sum())
        far = 20.0 * float(np.linalg.norm(self.config.mission.initial_state[:3]))
        names = (*SCIENCE, ALL) if observed else ()
        self.held_s = {name: Tally.empty(0.0, last - first, TIME_BIN_S) for name in names}
        self.full = dict.fromkeys(self.held_s, 0)
        self.entry = self.exit = Tally.empty(first, last, TIME_BIN_S)
        bins = self.config.mission.units.tolerance(DISTANCE_BIN_M, "m")
        self.closest = Tally.empty(0.0, far, bins)
        self.executed_dv = Tally.empty(0.0, 3.0 * max(planned, 1e-9), planned / 1e4 or 1e-9)
        again = policy_kind(self.config.policy) == "replan"
        self.failed = np.zeros(len(self.config.policy) if again else 0)
        # However small the planned burns are, corrected ones may be as large as their limit.
        most = planned + self.config.mission.scenario.burns.dv_max_m_s * len(self.config.burns_m_s)
        self.commanded_dv = Tally.empty(0.0, most, most * DV_BIN)

    def add(self, block: FlightBlock) -> None:
        """Count a block; blocks must come in order, so that sums round the same way every time."""
        first, last = self.config.mission.observed_s or (0.0, 0.0)
        for name, seconds in block.held_s.items():
            self.held_s[name] = self.held_s[name].add(seconds)
            self.full[name] += int((seconds >= last - first - 1e-6).sum())
        ever = np.isfinite(block.entry)
        if ever.any():
            self.entry = self.entry.add(block.entry[ever])
            self.exit = self.exit.add(block.exit[ever])
        for name, counts in block.node_counts.items():
            self.node_counts[name] = self.node_counts.get(name, np.zeros_like(counts)) + counts
        self.whole += block.whole
        self.closest = self.closest.add(block.closest_m)
        self.executed_dv = self.executed_dv.add(block.executed_dv_m_s)
        self.commanded_dv = self.commanded_dv.add(block.commanded_dv_m_s)
        for name, counts in block.limits.items():
            self.limits[name] = self.limits.get(name, np.zeros_like(counts)) + counts
        room = TERMINAL_KEPT - len(self.terminal)
        self.terminal = np.vstack([self.terminal, block.terminal[: max(room, 0)]])
        deviation = block.terminal - self.config.mission.final_state
        self.terminal_sum += deviation.sum(axis=0)
        self.terminal_outer += deviation.T @ deviation
        self.failed += block.failed
        self.samples += len(block.terminal)

    def worst_probability(self, name: str) -> tuple[float, Estimate]:
        """Time (s) at which a joint constraint holds in the fewest flights, and its probability.

        The narrower of the plain interval and the stratified one.
        """
        counts = self.node_counts[name]
        at = int(np.argmin(counts))
        plain = proportion(int(counts[at]), self.samples)
        if self.narrowed is not None:
            narrowed = self.narrowed.probability(name)
            if narrowed[1].width < plain.width:
                return narrowed
        return float(self.config.counted_s(name)[at]), plain

    def is_narrowed(self, name: str) -> bool:
        """Whether a joint constraint's probability is that of flights in strata."""
        narrowed = self.narrowed
        return narrowed is not None and self.worst_probability(name) == narrowed.probability(name)

    def widest_interval(self) -> float:
        """Width of the widest confidence interval among the joint probabilities."""
        return max(self.worst_probability(name)[1].width for name in self.node_counts)

    def terminal_covariance(self) -> Array:
        """Sample covariance of the final state, shape (6, 6)."""
        mean = self.terminal_sum / self.samples
        scatter = self.terminal_outer - self.samples * np.outer(mean, mean)
        return scatter / max(self.samples - 1, 1)


def fly_many(
    config: FlightConfig,
    *,
    samples: int,
    until: float | None = None,
    executor: Executor = here,
    progress: Callable[[int], None] | None = None,
    stop: Callable[[], bool] = lambda: False,
) -> FlightTally:
    """Fly `samples` flights, or fewer if every probability's interval is `until` wide before.

    Where an interval is wider after `PLAIN` flights, further flights in strata narrow the joint
    constraints' probabilities, at most as many as are left, if that is quicker: see `narrow`.

    The result does not depend on where the executor flies blocks, by default in this process. After
    each block `progress` is called with the number flown so far, and a true `stop()` ends the flights.

    Raises:
        InputError: if a block could not be flown.
    """
    flown = FlightTally(config)

    def has_ended() -> bool:
        narrow_enough = until is not None and flown.samples and flown.widest_interval() <= until
        return bool(narrow_enough or stop())

    def fly_to(count: int) -> None:
        first, last = flown.samples // BLOCK, -(-count // BLOCK)
        jobs = (Job(n, (n, min(BLOCK, count - n * BLOCK))) for n in range(first, last))
        with closing(in_order(executor, partial(run_block, config), jobs)) as coming:
            for done in coming:
                flown.add(done.result("flights", "block"))
                if progress:
                    progress(flown.samples)
                if has_ended():
                    break

    if until is not None and samples > PLAIN:
        fly_to(PLAIN)
        if has_ended():
            return flown
        flown.narrowed = _narrowed(flown, until, samples, executor, stop)
        if flown.narrowed is not None or stop():
            return flown
    fly_to(samples)
    return flown


def _narrowed(
    flown: FlightTally,
    until: float,
    samples: int,
    executor: Executor,
    stop: Callable[[], bool],
) -> Narrowed | None:
    """Probabilities of further flights in strata.

    None where burns are planned again, for which there is no law, where each flight has a window of its
    own, and after the window.
    """
    config, before = flown.config, flown.samples
    mission = config.mission
    if policy_kind(config.policy) == "replan" or mission.observed_s is None:
        return None
    if mission.edges.sigmas_s is not None:
        return None
    how = corrections_of(config.policy), config.truth, config.errors, config.window_samples_s
    flights = SampledFlights(config.mission, config.burns_m_s, *how)
    return narrow(flights, config.seed, before // BLOCK, until, samples - before, executor, stop)
