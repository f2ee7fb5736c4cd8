"""Fly a plan many times with errors, tallied block by block in constant memory."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import closing
from dataclasses import dataclass, field, replace
from functools import partial

import numpy as np
from scipy.special import ndtri

from formulations.arrays import Array, Indices
from formulations.risk.strata import Allocation, Counted, Survey, allocate
from scp_recon.jobs.job import Executor, Job, here, in_order
from scp_recon.jobs.processes import Limits
from scp_recon.mission.constraints import companion_distance_m
from scp_recon.mission.mission import Mission
from scp_recon.mission.windows import Window
from scp_recon.monte_carlo.closed_loop import MEASURED
from scp_recon.monte_carlo.estimates import CONFIDENCE, Estimate, Tally, of_strata, proportion
from scp_recon.monte_carlo.limits import (
    ALL,
    EVERYWHERE,
    SCIENCE,
    kept_limits,
    limit_margins,
    time_held,
)
from scp_recon.monte_carlo.sampling import BLOCK, Flyer, corrections_of, policy_kind
from scp_recon.monte_carlo.strata import DrawsInStrata, Law, StrataCounts, surveyed, worst_event
from scp_recon.monte_carlo.whole_flight import SampledFlights
from scp_recon.results.policy import with_policy

SAMPLES_MIN, SAMPLES_MAX, SEED_MAX = 20, 10**9, 2**63 - 1
"""Least number of flights: the normality test needs as many."""

SAMPLE_STEP_S = 60.0
"""Longest time between two samples in the window; crossings are then bisected."""

TIME_BIN_S, DISTANCE_BIN_M = 0.5, 0.1
DV_BIN = 1e-5
"""Bin of commanded delta-v, over the most that is expected."""
PLAIN = 10_000
"""Flights that are counted plainly before an interval's width asks for strata."""
LIMITS = Limits(seconds=3600.0)
"""Limits of a block, which takes a second or less: one that takes longer hangs."""
TERMINAL_KEPT = 5000
"""Final states kept for the normality test, whose distribution is tabulated up to this number."""
TAIL = 0.5 * (1.0 - CONFIDENCE)
BLOCKS = 20
"""Blocks of draws in a job."""
DRAW, TIMES = 0.09, (1.1, 1.3, 1.6, 2.0, 3.0, 4.0)
"""Time of a draw by the law over that of a flight sampled at given times; and draws per plain flight
that are tried."""
MORE = 0.25
"""Further draws where the intervals came out wider, over those of the first time."""


def window_samples(mission: Mission) -> Array:
    """Times in the rest of the window, s, at most `SAMPLE_STEP_S` apart, with edges and nodes."""
    return _samples(mission, mission.observed_s)


def watched_samples(mission: Mission) -> Array:
    """The same of `watched_s`, in which the windows of flights lie."""
    whole = _samples(mission, mission.edges.watched_s), mission.edges.samples_s
    return np.union1d(window_samples(mission), np.concatenate(whole))


def _samples(mission: Mission, span: Window | None) -> Array:
    if span is None:
        return np.zeros(0)
    first, last = span
    even = np.linspace(first, last, int(np.ceil((last - first) / SAMPLE_STEP_S)) + 1)
    nodes = mission.times_s
    return np.union1d(even, nodes[(nodes >= first) & (nodes <= last)])


@dataclass(frozen=True, eq=False)
class FlightBlock:
    """One block of flights: values of each, shape (flights,), and counts, as in `FlightTally`."""

    values: dict[str, Array]
    node_counts: dict[str, Indices]
    limits: dict[str, Indices]
    whole: int
    failed: Indices
    terminal: Array


def run_block(config: Flyer, block: tuple[int, int]) -> FlightBlock:
    """Fly a block, given as (its number, its number of flights)."""
    number, flights = block
    mission = config.mission
    samples, watched = window_samples(mission), watched_samples(mission)
    times = np.union1d(watched, mission.times_s)
    flown = config.fly_block(times, number, flights=flights)
    corrected = [one.burn for one in config.policy]
    of_burns = mission.problem.burn_margins(
        flown.commanded_m_s.swapaxes(0, 1) / mission.units.speed_m_s
    )
    observed, seen, nodes = (
        np.searchsorted(times, at) for at in (samples, watched, mission.times_s)
    )
    own, values = flown.mission, dict[str, Array]()
    if len(samples):
        held = time_held(own, samples, flown.states[observed])
        values = {name: one.duration for name, one in held.items()}
        ever = np.isfinite(held[ALL].entry)
        values |= {"entry_s": held[ALL].entry[ever], "exit_s": held[ALL].exit[ever]}
    position, certain = flown.states[..., :3], config.certain
    margins = limit_margins(own, times, position, seen, nodes, certain=certain)
    kept = kept_limits(margins, at_once=True)
    whole = flown.closest_m >= mission.scenario.safety.radius_min_m
    whole &= flown.apart_m >= companion_distance_m(mission.scenario)
    for _, holds in kept.values():
        whole &= holds.all(axis=0)
    sizes = (
        np.linalg.norm(dv, axis=2).sum(axis=1) for dv in (flown.burns_m_s, flown.commanded_m_s)
    )
    of_flights = flown.closest_m, *sizes
    return FlightBlock(
        values=values | dict(zip(FIGURES, of_flights, strict=True)),
        node_counts={name: holds.sum(axis=1) for name, (_, holds) in kept.items()},
        limits={name: (margin[corrected] >= 0.0).sum(axis=1) for name, margin in of_burns.items()},
        whole=int(whole.sum()),
        failed=flown.failed.sum(axis=1),
        terminal=flown.states[-1],
    )


FIGURES = "closest_m", "executed_dv_m_s", "commanded_dv_m_s"
"""A flight's smallest distance from the body's centre, total delta-v executed and commanded."""


@dataclass(eq=False)
class FlightTally:
    """Running totals of the flights of a configuration.

    Attributes:
        tallies: by observation constraint, and `all` at once, seconds in which it holds; `entry_s` and
            `exit_s`, the first and last time at which all hold, of the flights in which they ever do;
            and the `FIGURES`.
        full: flights in which each observation constraint holds throughout the window.
        node_counts: flights in which each joint constraint holds, at the nodes or the watched samples.
        whole: flights that keep every limit on the position at every sampled time.
        limits: flights in which each corrected burn keeps each limit on burns, shape (k,).
        failed: flights in which planning each burn again failed, shape (k,); empty without.
        terminal: final states of the first flights.
        narrowed: of flights in strata for each joint constraint, the time at which it may be least
            likely, s, and the counts there; none without such flights.
    """

    config: Flyer
    samples: int = 0
    tallies: dict[str, Tally] = field(init=False)
    full: dict[str, int] = field(init=False)
    node_counts: dict[str, Indices] = field(default_factory=dict)
    whole: int = 0
    limits: dict[str, Indices] = field(default_factory=dict)
    failed: Array = field(init=False)
    terminal: Array = field(default_factory=lambda: np.empty((0, 6)))
    terminal_sum: Array = field(default_factory=lambda: np.zeros(6))
    terminal_outer: Array = field(default_factory=lambda: np.zeros((6, 6)))
    narrowed: dict[str, tuple[float, Counted]] = field(default_factory=dict)

    def __post_init__(self) -> None:
        """Make empty tallies that span all values that can occur."""
        mission, burns = self.config.mission, self.config.burns_m_s
        observed = mission.observed_s
        first, last = observed or mission.schedule.window_s
        planned = float(np.linalg.norm(burns, axis=1).sum())
        far = 20.0 * float(np.linalg.norm(mission.initial_state[:3]))
        # However small the planned burns are, corrected ones may be as large as their limit.
        most = planned + mission.scenario.burns.dv_max_m_s * len(burns)
        names = (*SCIENCE, ALL) if observed else ()
        spans = dict.fromkeys(names, (0.0, last - first, TIME_BIN_S))
        spans |= dict.fromkeys(("entry_s", "exit_s"), (first, last, TIME_BIN_S))
        spans["closest_m"] = 0.0, far, mission.units.tolerance(DISTANCE_BIN_M, "m")
        spans["executed_dv_m_s"] = 0.0, 3.0 * max(planned, 1e-9), planned / 1e4 or 1e-9
        spans["commanded_dv_m_s"] = 0.0, most, most * DV_BIN
        self.tallies = {name: Tally.empty(*span) for name, span in spans.items()}
        self.full = dict.fromkeys(names, 0)
        again = policy_kind(self.config.policy) == "replan"
        self.failed = np.zeros(len(self.config.policy) if again else 0)

    def add(self, block: FlightBlock) -> None:
        """Count a block; blocks must come in order, so that sums round the same way every time."""
        first, last = self.config.mission.observed_s or (0.0, 0.0)
        for name, values in block.values.items():
            if len(values):
                self.tallies[name] = self.tallies[name].add(values)
        for name in self.full:
            self.full[name] += int((block.values[name] >= last - first - 1e-6).sum())
        for own, more in ((self.node_counts, block.node_counts), (self.limits, block.limits)):
            own.update({name: own.get(name, 0) + counts for name, counts in more.items()})
        self.whole += block.whole
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
        if name in self.narrowed:
            time_s, counted = self.narrowed[name]
            if (narrowed := of_strata(counted, CONFIDENCE)).width < plain.width:
                return time_s, narrowed
        mission = self.config.mission
        times = mission.times_s if name in EVERYWHERE else watched_samples(mission)
        return float(times[at]), plain

    def is_narrowed(self, name: str) -> bool:
        """Whether a joint constraint's probability is that of flights in strata."""
        if name not in self.narrowed:
            return False
        return self.worst_probability(name)[1] == of_strata(self.narrowed[name][1], CONFIDENCE)

    def widest_interval(self) -> float:
        """Width of the widest confidence interval among the joint probabilities."""
        return max(self.worst_probability(name)[1].width for name in self.node_counts)

    def terminal_covariance(self) -> Array:
        """Sample covariance of the final state, shape (6, 6)."""
        mean = self.terminal_sum / self.samples
        scatter = self.terminal_outer - self.samples * np.outer(mean, mean)
        return scatter / max(self.samples - 1, 1)


def fly_many(
    config: Flyer,
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
        flown.narrowed = narrow(config, flown.samples, until, samples, executor, stop)
        if flown.narrowed or stop():
            return flown
    fly_to(samples)
    return flown


def narrow(
    config: Flyer,
    flown: int,
    until: float,
    samples: int,
    executor: Executor,
    stop: Callable[[], bool] = lambda: False,
) -> dict[str, tuple[float, Counted]]:
    """Draw and fly in strata until every joint constraint's interval has a given width.

    Some thousands of plain flights suffice for all other statistics. A narrow interval of a probability
    needs far more flights. Further flights are therefore drawn in strata of the law's margin. Each
    joint constraint at each time is an event of its own. The result does not depend on the executor.
    `flown` are the plain flights so far, in whole blocks, and `samples` all at most.

    Returns:
        See `FlightTally`; with wider intervals than `until` if that many flights do not suffice. Empty
            if plain flights are cheaper or all the same, if there is no law or if each flight has a
            window of its own, after the window, and after a stop.
    """
    mission, how = config.mission, (corrections_of(config.policy), config.truth, config.errors)
    if mission.observed_s is None or mission.edges.sigmas_s is not None:
        return {}
    flights = SampledFlights(mission, config.burns_m_s, *how, config.seed, window_samples(mission))
    law = _law(config)
    drawn = config.sources + MEASURED * len(config.policy)
    if config.certain or not law.limits or law.sources != drawn:
        return {}
    law, survey = surveyed(law, flights)
    if (first := _allocation(survey, until)) is None:
        return {}
    share, draws, worst = float(np.dot(first.share, survey.share)), 0.0, {}
    more, total, block, spent = first, None, flown // BLOCK, flown
    while spent + share * more.draws <= samples:
        work, draws = DrawsInStrata(law, flights, more), draws + more.draws
        blocks, every = work.blocks(block), replace(first, draws=draws)
        jobs = (Job(k, blocks[k : k + BLOCKS]) for k in range(0, len(blocks), BLOCKS))
        with closing(in_order(executor, work.count, jobs)) as coming:
            for done in coming:
                counts: StrataCounts = done.result("flights", "job")
                total = counts if total is None else total + counts
                if stop():
                    return {}
        assert total is not None
        for name, times in flights.counted_s.items():
            event, counted = worst_event(every, total.of(name), TAIL)
            worst[name] = float(times[event]), counted
        if max(of_strata(one, CONFIDENCE).width for _, one in worst.values()) <= until:
            break
        block, spent = block + len(blocks), flown + total.flown
        more = replace(first, draws=MORE * first.draws)
    return worst


def _law(config: Flyer) -> Law:
    """The law of flights, with their errors, and with their corrections if the mission has these.

    It lacks columns for numbers that a flight draws if the flight plans again.
    """
    mission, policy = config.mission, corrections_of(config.policy)
    feedback, corrected = mission.feedback, [one.burn for one in policy]
    closed = feedback is not None and corrected == feedback.burns.tolist()
    problem = mission.problem if closed else mission.problem.open_loop
    lin = with_policy(mission, config.linearised(problem), policy)
    return Law.of(mission, lin, {ALL: SCIENCE})


def _allocation(survey: Survey, until: float) -> Allocation | None:
    """Allocation of draws for intervals of the required width."""
    q = survey.failed
    plain = int(4.0 * float(ndtri(TAIL)) ** 2 * max(q * (1.0 - q), until / 4.0) / until**2) + 1
    reached = proportion(round((1.0 - q) * plain), plain)
    scale = until / reached.width
    widths = scale * (reached.value - reached.low), scale * (reached.high - reached.value)
    return allocate(survey, plain, widths, TAIL, mirrored=True, draw=DRAW, times=TIMES)
