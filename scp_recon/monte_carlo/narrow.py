"""Narrow the intervals of joint probabilities to a width, by flying few of many draws.

Some thousands of plain flights suffice for all other statistics. A narrow interval of a probability
needs far more flights. Further flights are therefore drawn in strata of the law's margin. Each
joint constraint at each time is an event of its own.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from contextlib import closing
from dataclasses import dataclass, replace

import numpy as np
from scipy.special import ndtri

from formulations.risk.strata import Allocation, Counted, Survey, allocate
from scp_recon.jobs.job import Executor, Job, in_order
from scp_recon.mission.scene import errors_of_kind
from scp_recon.monte_carlo.closed_loop import MEASURED
from scp_recon.monte_carlo.estimates import CONFIDENCE, Estimate, of_strata, proportion
from scp_recon.monte_carlo.law import Law, blocks_of
from scp_recon.monte_carlo.law_in_time import CountsInTime, DrawsInTime, Events, survey_in_time
from scp_recon.monte_carlo.limits import EVERYWHERE
from scp_recon.monte_carlo.observation_time import ALL, SCIENCE
from scp_recon.monte_carlo.sampling import corrections_of
from scp_recon.monte_carlo.whole_flight import SampledFlights
from scp_recon.planning.initial_guess import from_burns
from scp_recon.results.policy import with_policy

TAIL = 0.5 * (1.0 - CONFIDENCE)
DRAW, TIMES = 0.09, (1.1, 1.3, 1.6, 2.0, 3.0, 4.0)
"""Time of a draw by the law over that of a flight sampled at given times; and draws per plain flight
that are tried."""
MORE = 0.25
"""Further draws where the intervals came out wider, over those of the first time."""
BLOCKS = 20
"""Of draws in a job."""


@dataclass(frozen=True)
class Narrowed:
    """Probabilities of flights in strata.

    Attributes:
        draws: in all.
        flights: of them.
        worst: for each joint constraint, the time at which it may be least likely, s, and the
            counts there.
    """

    draws: int
    flights: int
    worst: Mapping[str, tuple[float, Counted]]

    def probability(self, name: str) -> tuple[float, Estimate]:
        """Time at which a joint constraint may be least likely, s, and its probability there."""
        time_s, counted = self.worst[name]
        return time_s, of_strata(counted, CONFIDENCE)

    @property
    def widest(self) -> float:
        """Width of the widest interval."""
        found = [self.probability(name)[1] for name in self.worst]
        return max(one.width for one in found)


def _law(flights: SampledFlights) -> dict[str, Law]:
    """Laws of the flights, with their errors, and with their corrections if the mission has these.

    None if a flight draws numbers for which the linearised flight has no columns.
    """
    mission, burns, speed = flights.mission, flights.burns_m_s, flights.mission.units.speed_m_s
    feedback, corrected = mission.feedback, [one.burn for one in flights.policy]
    closed = feedback is not None and corrected == feedback.burns.tolist()
    problem = mission.problem if closed else mission.problem.open_loop
    errors = errors_of_kind(mission.scenario, flights.errors).in_units(speed)
    problem = replace(problem, execution_errors=errors)
    lin = mission.dynamics.linearise(problem, from_burns(mission, burns))
    lin = with_policy(mission, lin, corrections_of(flights.policy))
    laws = Law.of_events(lin, mission.units.length_m, {ALL: SCIENCE})
    drawn = flights.sources + MEASURED * len(corrected)
    return laws if laws and next(iter(laws.values())).sources == drawn else {}


def narrow(
    flights: SampledFlights,
    seed: int,
    first: int,
    until: float,
    most: int,
    executor: Executor,
    stop: Callable[[], bool] = lambda: False,
) -> Narrowed | None:
    """Draw and fly until every joint constraint's interval has a given width.

    Args:
        flights: fly draws.
        seed: of the draws.
        first: block of draws from which on none has been flown.
        until: width.
        most: flights.
        executor: runs the jobs; the result does not depend on it.
        stop: returns whether to stop; called after each job.

    Returns:
        The probabilities, with wider intervals if `most` flights do not suffice; None if plain
            flights are cheaper or all the same, or after a stop.
    """
    mission = flights.mission
    if flights.times_s is None or flights.certain or not (laws := _law(flights)):
        return None
    law, known = survey_in_time(laws, mission.times_s, flights, seed)
    allocation = _allocation(known, until)
    expected = 0.0 if allocation is None else float(np.dot(allocation.share, known.share))
    if allocation is None or expected * allocation.draws > most:
        return None
    names = [*dict.fromkeys(constraint.event for constraint in mission.problem.constraints), ALL]
    times = {n: mission.times_s if n in EVERYWHERE else flights.times_s for n in names}
    counts: dict[str, CountsInTime] = {}
    found, drawn = None, allocation
    while found is None or (
        found.widest > until and found.flights + expected * drawn.draws <= most
    ):
        work = DrawsInTime(law, flights, times, drawn, seed)
        blocks = blocks_of(drawn, seed, first)
        first += len(blocks)
        jobs = (Job(k, blocks[k : k + BLOCKS]) for k in range(0, len(blocks), BLOCKS))
        with closing(in_order(executor, work.count, jobs)) as coming:
            for done in coming:
                more: dict[str, CountsInTime] = done.result("flights", "job")
                counts = {
                    name: more[name] + counts[name] if counts else more[name] for name in names
                }
                if stop():
                    return None
        found = _narrowed(counts, allocation if found is None else _both(found, drawn))
        drawn = replace(allocation, draws=MORE * allocation.draws)
    return found


def _allocation(known: Survey, until: float) -> Allocation | None:
    """Allocation of draws for intervals of the required width."""
    q = known.failed
    plain = int(4.0 * float(ndtri(TAIL)) ** 2 * max(q * (1.0 - q), until / 4.0) / until**2) + 1
    reached = proportion(round((1.0 - q) * plain), plain)
    scale = until / reached.width
    widths = scale * (reached.value - reached.low), scale * (reached.high - reached.value)
    return allocate(known, plain, widths, TAIL, mirrored=True, draw=DRAW, times=TIMES)


def _both(found: Narrowed, more: Allocation) -> Allocation:
    """The allocation of all draws so far and of more."""
    before = next(iter(found.worst.values()))[1].allocation
    return replace(before, draws=before.draws + more.draws)


def _narrowed(counts: Mapping[str, CountsInTime], allocation: Allocation) -> Narrowed:
    worst = {
        name: Events.all_of({name: count}, allocation).worst(TAIL) for name, count in counts.items()
    }
    _, one = next(iter(worst.values()))
    return Narrowed(sum(one.drawn), sum(one.flown), worst)
