"""Records of planning, as the solution file stores them: certificate, starts, parent plan; SI."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Literal

from pydantic import Field

from formulations.risk.strata import Counted
from scp_recon.display import mm_s
from scp_recon.scenario.fields import Line, Number, Probability

Problem = Literal["P3", "P2"]
"""P3 is without uncertainty, P2 with it."""


@dataclass(frozen=True)
class Certificate:
    """Probability that nonlinear flights of an exact plan reach, at the worst node or as a whole.

    Attributes:
        samples: flights of the test that judged the plan.
        seed: of their errors, which planning has not seen.
        reached: probability that they reach at every second.
        low: lower end of its exact interval; the plan is certified if this is at least the required
            one.
        high: upper end of it.
        at_nodes: the same of the nodes alone.
        rounds: plans flown to choose the target, before any test.
        tests: number of the test that judged the plan, from 1; each test flies another plan.
        confidence: of the interval, both ends together.
        strata: draws and flights in strata of the law's margin; None for plain flights.
    """

    samples: Annotated[int, Field(ge=1)]
    seed: Annotated[int, Field(ge=0)]
    reached: Probability
    low: Probability
    high: Probability
    at_nodes: Probability
    rounds: Annotated[int, Field(ge=1)]
    tests: Annotated[int, Field(ge=1)]
    confidence: Probability
    strata: Counted | None = None

    def certifies(self, required: float) -> bool:
        """Whether the certificate proves a required probability."""
        return self.low >= required

    @property
    def interval(self) -> str:
        """The interval of the probability in words."""
        return f"{100 * self.confidence:g} % interval {self.low:.4f} to {self.high:.4f}"

    def __str__(self) -> str:
        """The certificate in words."""
        of = f" out of {sum(self.strata.drawn)} draws" if self.strata else ""
        flights = f"{self.samples} flights{of} of test {self.tests}"
        return f"{flights} reached {self.reached:.4f} ({self.interval})"


@dataclass(frozen=True)
class Optimum:
    """A local optimum that several starts found: converged, or stationary at the least violation.

    Attributes:
        problem: that was solved.
        status: how its starts ended.
        total_dv_m_s: sum of its burns' sizes.
        burns_m_s: its burns, J2000.
        starts: numbers of those that ended there, 0 the initial guess.
    """

    problem: Problem
    status: Line
    total_dv_m_s: Number
    burns_m_s: tuple[tuple[Number, Number, Number], ...]
    starts: tuple[Annotated[int, Field(ge=0)], ...]

    def __str__(self) -> str:
        """One line."""
        many = f"{len(self.starts)} start{'s' if len(self.starts) > 1 else ''}"
        return f"{self.problem} {self.status} {self.total_dv_m_s:.6f} m/s, {many}"


@dataclass(frozen=True)
class Starts:
    """Several starts, the guess included; the plan is the best of them.

    Attributes:
        number: of starts.
        seed: of the random ones.
        optima: each local optimum once.
    """

    number: Annotated[int, Field(ge=2)]
    seed: Annotated[int, Field(ge=0)]
    optima: tuple[Optimum, ...]

    @property
    def chance(self) -> float:
        """Expected chance that a further start leads to a new optimum of P3, 1 where it is not known.

        Without an optimum, minima of P3's violation count in their place.
        w (w + 1) / (n (n - 1)) for n starts that led to w optima: Boender and Rinnooy Kan, "Bayesian
        stopping rules for multistart global optimization methods", Math. Programming 37, 1987.
        """
        p3 = self.converged or [one for one in self.optima if one.problem == "P3"]
        w, n = len(p3), len({number for one in p3 for number in one.starts})
        return min(1.0, w * (w + 1) / (n * (n - 1))) if n > 1 else 1.0

    @property
    def converged(self) -> list[Optimum]:
        """Optima of P3."""
        return [one for one in self.optima if one.problem == "P3" and one.status == "converged"]

    def __str__(self) -> str:
        """In words."""
        p3 = len(self.converged)
        optima = f"{p3} optim{'um' if p3 == 1 else 'a'} of P3"
        if not p3:
            minima = sum(one.problem == "P3" for one in self.optima)
            optima += f", {minima} minim{'um' if minima == 1 else 'a'} of its violation"
        return (
            f"{self.number} starts, {optima}; expected chance that a further start finds a new one "
            f"{100 * self.chance:.1f} %"
        )


@dataclass(frozen=True)
class WithoutUncertainty:
    """What the cheapest P3 costs that planning found. P3 may have cheaper optima.

    Attributes:
        total_dv_m_s: sum of its burns' sizes.
        optima: number of different optima of P3 that planning found.
    """

    total_dv_m_s: Number
    optima: Annotated[int, Field(ge=1)]

    def __str__(self) -> str:
        """In words."""
        of = "one optimum" if self.optima == 1 else f"least of {self.optima} optima"
        return f"{mm_s(self.total_dv_m_s)} without uncertainty ({of} of P3 found)"


@dataclass(frozen=True)
class Parent:
    """The plan that was flown before another was made in flight.

    Attributes:
        name: its file, or words for it.
        plan_hash: its hash.
        at_s: time of the state from which the new one was made, past the epoch.
        commanded_m_s: the next burn as its policy alone would command it from that state, J2000; None
            of a plan without corrections, and where gains act on earlier estimates too.
    """

    name: Line
    plan_hash: Line
    at_s: float
    commanded_m_s: tuple[Number, Number, Number] | None = None
