"""Flights of a plan under certification: rounds, by which it aims, and looks, which judge it.

A look's flights have seeds that no round uses, so that what they reach is no reason why the plan is the
one that they judge.
"""

from __future__ import annotations

from dataclasses import replace
from functools import partial
from typing import NamedTuple, Protocol

import numpy as np

from formulations.arrays import Array
from scp_recon.mission.mission import Mission
from scp_recon.monte_carlo.estimates import (
    FIRST_SEED,
    LOOK_CONFIDENCE,
    Estimate,
    look_interval,
    look_seed,
    proportion,
)
from scp_recon.monte_carlo.whole_flight import KeptFlights, kept_flights
from scp_recon.planning.plan import Certificate, Plan

LOST_BETWEEN = 0.05
"""Share of 1 - p that flights may lose between nodes."""


class Watch(Protocol):
    """Is told how certifying goes on."""

    def __call__(
        self,
        step: str,
        plan: Plan,
        samples: int,
        flown: int = 0,
        reached: Estimate | None = None,
        /,
    ) -> None:
        """Of the flights of a step, such as "round 2" or "look 1", so many are flown.

        Once all are, it is told what they reached.
        """
        ...


class Kept(NamedTuple):
    """Flights of some that keep what the scope asks for: at the nodes, and at all times."""

    at_nodes: int
    throughout: int
    samples: int

    @property
    def reached(self) -> float:
        """Share of the flights that keep it at all times."""
        return self.throughout / self.samples

    def are_close(self, asked: float) -> bool:
        """Whether flights lose so little between nodes that none are missing."""
        return self.at_nodes - self.throughout <= LOST_BETWEEN * (1.0 - asked) * self.samples


def kept_of(mission: Mission, flown: KeptFlights) -> Kept:
    """What the scope asks for."""
    if mission.scenario.risk.scope == "flight":
        return Kept(flown.whole_at_nodes, flown.whole, flown.samples)
    at_nodes = min(int(counts.min()) for counts in flown.at_nodes.values())
    return Kept(at_nodes, min(flown.throughout.values()), flown.samples)


def fly_round(
    plan: Plan, samples: int, number: int, watch: Watch | None = None
) -> tuple[Kept, Array]:
    """Fly a plan to learn what it reaches.

    Returns:
        What its flights keep, and the times between nodes at which they touch a limit, s.
    """
    step = f"round {number}"
    kept, touched_s = _fly(plan, samples, FIRST_SEED + number - 1, step, watch)
    if watch:
        watch(step, plan, samples, samples, proportion(kept.throughout, samples))
    return kept, touched_s


def look_at(
    plan: Plan, samples: int, number: int, rounds: int, watch: Watch | None = None
) -> tuple[Plan, Kept, Array]:
    """Judge a plan by flights of which nothing is known, after so many rounds.

    Returns:
        The plan with its certificate; and as `fly_round`.
    """
    step = f"look {number}"
    kept, touched_s = _fly(plan, samples, look_seed(number), step, watch)
    judged = replace(plan, certificate=certificate_of(kept, number, rounds))
    if watch:
        watch(step, judged, samples, samples, look_interval(kept.throughout, samples))
    return judged, kept, touched_s


def certificate_of(kept: Kept, look: int, rounds: int) -> Certificate:
    """What the flights of a look come to."""
    reached = look_interval(kept.throughout, kept.samples)
    return Certificate(
        kept.samples,
        look_seed(look),
        *reached,
        at_nodes=kept.at_nodes / kept.samples,
        rounds=rounds,
        looks=look,
        confidence=LOOK_CONFIDENCE,
    )


def with_nodes_at(mission: Mission, times_s: Array) -> Mission:
    """The mission with a node in each arc in which flights touch a limit, where most of them do."""
    arcs = np.searchsorted(mission.times_s, times_s)
    new = {float(round(float(np.median(times_s[arcs == arc])))) for arc in np.unique(arcs)}
    nodes = sorted({*mission.scenario.grid.nodes_s} | (new - set(mission.times_s.tolist())))
    return mission.changed({"grid.nodes_s": nodes})


def _fly(plan: Plan, samples: int, seed: int, step: str, watch: Watch | None) -> tuple[Kept, Array]:
    seen = None
    if watch:
        watch(step, plan, samples)
        seen = partial(watch, step, plan, samples)
    flown = kept_flights(plan.mission, plan.burns_m_s, samples, seed, seen)
    return kept_of(plan.mission, flown), flown.touched_s
