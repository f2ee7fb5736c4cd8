"""Plan and fly anew until flights reach the required probability, and no more.

A plan keeps its constraints with the probability that it aims at, under the normal law that linear
dynamics propagate. What nonlinear flights reach differs a little, and an estimate's lower limit lies
below it. So the plan aims above what is asked, on the normal quantile scale by what that takes, flies,
and aims higher where the lower limit falls short, lower where they reach more than sampling explains.
Where flights touch a limit between nodes, nodes are added there.

On the normal quantile scale flights reach less than was aimed at by nearly the same, whatever the aim:
the flow's curvature, and what happens between nodes, take it. Each round's flights measure that loss
with the error of their sampling; the mean over rounds is surer than the last one's.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Protocol

import numpy as np
from scipy.special import ndtr, ndtri

from formulations.arrays import Array
from formulations.problem.flyby import Iterate
from scp_recon.mission.mission import Mission
from scp_recon.monte_carlo.estimates import (
    FIRST_SEED,
    Estimate,
    flights_needed,
    proportion,
    successes_needed,
)
from scp_recon.monte_carlo.whole_flight import KeptFlights, kept_flights
from scp_recon.planning.initial_guess import from_burns
from scp_recon.planning.plan import Certificate, Plan, as_interrupted
from scp_recon.scp.status import Status

ROUNDS_MAX = 6

LOST_BETWEEN = 0.05
"""Share of 1 - p that flights may lose between nodes."""

EXCESS = 1.0
"""Standard errors of what rounds have measured, up to which sampling explains that a plan reaches more
than it has to. In rounds drawn from binomial laws with losses of -1 to 3 standard errors plans end 0.3
above what is needed in the mean and 1.3 in 95 of 100, after 2.6 rounds; if the first success ended it,
0.75 and 1.9 after 2. One of 1,000 reaches less than was required."""

BINDING = 0.01
"""Standard deviations between aim and law, up to which a constraint binds."""

AimedPlanning = Callable[[Mission, Iterate, float], Plan]
"""A plan of a mission from a start, aiming at a probability."""


class Watch(Protocol):
    """Is told how certifying goes on."""

    def __call__(self, number: int, plan: Plan, samples: int, flown: int = 0, /) -> None:
        """Of a round's flights so many are flown; once all are, the plan has a certificate."""
        ...


def certify(
    mission: Mission, start: Iterate, make_plan: AimedPlanning, watch: Watch | None = None
) -> Plan:
    """Plan so that the lower limit of the probability reached is at least the required one.

    The mission's allocation is exact. Rounds after the first start at the last one's burns. Ctrl-C
    ends with the best plan so far, marked as interrupted.

    Returns:
        The cheapest plan that reaches what is required, with its certificate; where none does the one
            that comes nearest, whose certificate says so. Where an aim is infeasible before any round
            has succeeded, or the first comes to no verdict, that round's plan, without a certificate.
    """
    asked = mission.scenario.risk.p_chance
    rounds = _Rounds(asked, Aiming(asked, flights_needed(asked)))
    try:
        return rounds.run(mission, start, make_plan, watch)
    except KeyboardInterrupt:
        best = rounds.best or rounds.made
        if best is None:
            raise
        return as_interrupted(best)


@dataclass
class _Rounds:
    """State of one certification: the last plan, flown plans, and whether nodes were close enough."""

    asked: float
    aiming: Aiming
    made: Plan | None = None
    flown: list[tuple[Plan, bool]] = field(default_factory=list)

    def run(
        self, mission: Mission, start: Iterate, make_plan: AimedPlanning, watch: Watch | None
    ) -> Plan:
        samples = self.aiming.samples
        for number in range(1, ROUNDS_MAX + 1):
            target = self.aiming.next()
            plan = make_plan(mission, start, target)
            if plan.status is Status.INTERRUPTED and self.made is not None:
                raise KeyboardInterrupt
            if plan.status is Status.INFEASIBLE:
                return self.certified or plan
            if plan.status is not Status.CONVERGED:
                return self.best or plan
            self.made = plan
            if watch:
                watch(number, plan, samples)
            seed = FIRST_SEED + number - 1
            seen = partial(watch, number, plan, samples) if watch else None
            kept = kept_flights(mission, plan.burns_m_s, samples, seed, seen)
            plan = replace(plan, certificate=certificate_from(mission, kept, seed, number))
            if watch:
                watch(number, plan, samples)
            if not self._learn(plan):
                mission = with_nodes_at(mission, kept.touched_s)
            elif self._is_settled:
                break
            start = from_burns(mission, plan.burns_m_s, "certify")
        best = self.best
        assert best is not None
        return best

    def _learn(self, plan: Plan) -> bool:
        """Keep a round, and take in what it reached; whether its nodes are close enough."""
        reached = plan.certificate
        assert reached is not None
        close = are_close(reached, self.asked)
        self.flown.append((plan, close))
        if reached.low < self.asked:
            self.aiming.tries += 1
        law = float(ndtr(ndtri(_target(plan)) + max(slack(plan), 0.0)))
        if close:
            self.aiming.learn(law, reached.reached)
        else:
            self.aiming.begin_again(law, reached.at_nodes)
        return close

    @property
    def _is_settled(self) -> bool:
        """Whether a plan reaches what is required, and its surplus is within sampling error.

        Or its constraints do not bind, so that a lower aim would save nothing.
        """
        best = self._cheapest(close=True)
        if best is None:
            return False
        return slack(best) > BINDING or self.aiming.excess(_target(best)) <= EXCESS

    @property
    def certified(self) -> Plan | None:
        """The cheapest plan that reaches what is required, on nodes close enough if there is one."""
        return self._cheapest(close=True) or self._cheapest(close=False)

    def _cheapest(self, *, close: bool) -> Plan | None:
        reached = [p for p, near in self.flown if near is close and _low(p) >= self.asked]
        return min(reached, key=lambda p: p.total_dv_m_s, default=None)

    @property
    def best(self) -> Plan | None:
        """The one that is certified, or the one that comes nearest."""
        plans = [plan for plan, _ in self.flown]
        return self.certified or max(plans, key=_low, default=None)


def _low(plan: Plan) -> float:
    assert plan.certificate is not None
    return plan.certificate.low


def _target(plan: Plan) -> float:
    assert plan.target is not None
    return plan.target


def slack(plan: Plan) -> float:
    """By how many standard deviations the normal law's probabilities exceed the aim."""
    return min(margin for margin, unit in plan.worst_margins.values() if unit == "sigma")


def certificate_from(mission: Mission, kept: KeptFlights, seed: int, rounds: int) -> Certificate:
    """What flights reached."""
    at_nodes, reached = judged(mission, kept)
    return Certificate(kept.samples, seed, *reached, at_nodes.value, rounds)


def judged(mission: Mission, kept: KeptFlights) -> tuple[Estimate, Estimate]:
    """What the scope asks for: at the nodes, and at all times."""
    if mission.scenario.risk.scope == "flight":
        return proportion(kept.whole_at_nodes, kept.samples), proportion(kept.whole, kept.samples)
    at_nodes = min(int(counts.min()) for counts in kept.at_nodes.values())
    return proportion(at_nodes, kept.samples), proportion(
        min(kept.throughout.values()), kept.samples
    )


def are_close(reached: Certificate, asked: float) -> bool:
    """Whether flights lose so little between nodes that none are missing."""
    return reached.at_nodes - reached.reached <= LOST_BETWEEN * (1.0 - asked)


def with_nodes_at(mission: Mission, times_s: Array) -> Mission:
    """The mission with a node in each arc in which flights touch a limit, where most of them do."""
    arcs = np.searchsorted(mission.times_s, times_s)
    new = {float(round(float(np.median(times_s[arcs == arc])))) for arc in np.unique(arcs)}
    nodes = sorted({*mission.scenario.grid.nodes_s} | (new - set(mission.times_s.tolist())))
    return Mission.from_scenario(mission.scenario.replace({"grid.nodes_s": nodes}))


SPARE = 0.1
"""Standard errors of the estimate by which a round aims above what it has to reach, and as much again
for each one after the first that did not."""

LEAST, MOST = 0.501, 1.0 - 1e-9
"""Aims: the constraint is convex above one half."""


@dataclass
class Aiming:
    """The aim of rounds of flights, so that the lower limit of what they reach is what is asked.

    Losses are of the rounds on the present nodes, in standard deviations; tries are the rounds that
    have not reached the required probability.
    """

    asked: float
    samples: int
    losses: list[float] = field(default_factory=list)
    tries: int = 0

    @property
    def needed(self) -> float:
        """Share of the flights whose lower limit is the required probability."""
        return successes_needed(self.asked, self.samples) / self.samples

    @property
    def error(self) -> float:
        """Standard error of what a round reaches."""
        return float(np.sqrt(self.needed * (1.0 - self.needed) / self.samples))

    @property
    def loss(self) -> float:
        """Mean of the losses; none is expected before any flight."""
        return float(np.mean(self.losses)) if self.losses else 0.0

    def learn(self, law: float, reached: float) -> None:
        """Take in what flights reached of a probability by the normal law."""
        self.losses.append(float(ndtri(law)) - self._quantile(reached))

    def begin_again(self, law: float, at_nodes: float) -> None:
        """Forget the rounds on other nodes, but for what the last lost at its nodes.

        What it lost between them the nodes that are added give back.
        """
        self.losses = []
        self.learn(law, at_nodes)

    def next(self) -> float:
        """What to aim at to reach what is needed."""
        above = self.needed + SPARE * max(1, self.tries) * self.error
        return float(np.clip(ndtr(self._quantile(above) + self.loss), LEAST, MOST))

    def excess(self, target: float) -> float:
        """By how much an aim spends too little, in standard errors of what the rounds have measured.

        Positive where it reaches more than what is needed.
        """
        most, least = (ndtr(ndtri(target) - self.loss) for target in (target, self.next()))
        return float((most - least) / self.error * np.sqrt(len(self.losses)))

    def _quantile(self, probability: float) -> float:
        half = 0.5 / self.samples
        return float(ndtri(np.clip(probability, half, 1.0 - half)))
