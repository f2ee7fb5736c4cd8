"""The summary of many flights, as in `montecarlo.json`: its parts, written and read, in SI."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any, Self

import numpy as np
from pydantic import Field, model_validator

from scp_recon.display import Displayed, mm_s
from scp_recon.files import write_atomically
from scp_recon.mission.scene import TruthModel
from scp_recon.monte_carlo.estimates import Estimate
from scp_recon.monte_carlo.limits import ALL, SCIENCE
from scp_recon.monte_carlo.sampling import ErrorModel, PolicyKind
from scp_recon.results.read import File, read_file
from scp_recon.results.solution import Solution
from scp_recon.results.verification import DriftSafety
from scp_recon.scenario.fields import ByName, Line, Section

SCHEMA = "scp_recon.montecarlo/1"
MARK = b'"schema": "scp_recon.montecarlo/'
"""Text in every file of flights, of any version."""
FILE_NAME, MISSES = "montecarlo.json", "montecarlo_miss_*.json"
"""Files of a plan's flights, and of those that miss a burn."""

COMPONENTS = ("x", "y", "z", "vx", "vy", "vz")
"""Components of the final state, J2000."""
WIDER = 1.25
"""Sampled over predicted sigma of the final state beyond which the linear law is said to miss it."""
ONE_SIGMA, TWO_SIGMA, CLOSEST = 0.15866, 0.02275, 0.003
"""Lower normal tails at one and two sigma; the paper's quantile of the closest approach."""
MOST = 0.99
"""Quantile of the commanded delta-v."""

Count = Annotated[int, Field(ge=0)]


class Interval(Section):
    """A value and its confidence interval; null stands for an infinite end or no value.

    Attributes:
        value: the estimate.
        low: lower end.
        high: upper end.
    """

    value: float | None
    low: float | None
    high: float | None

    @classmethod
    def of(cls, estimate: Estimate, **further: Any) -> Self:
        """Make it of an estimate and what else it has."""
        finite = {k: v if np.isfinite(v) else None for k, v in estimate._asdict().items()}
        return cls(**finite, **further)

    @property
    def estimate(self) -> Estimate:
        """The interval as an estimate with infinite ends, and NaN for no value."""
        return Estimate(
            np.nan if self.value is None else self.value,
            -np.inf if self.low is None else self.low,
            np.inf if self.high is None else self.high,
        )


class LowestProbability(Interval):
    """Probability of a joint constraint at the time when it is lowest.

    Attributes:
        worst_t_s: that time, past the epoch.
    """

    worst_t_s: float


class Histogram(Section):
    """Bins of one width that are not empty: where each starts, and its number of flights.

    Attributes:
        bin: width of all of them, s.
        start: of each, s.
        count: of flights in each.
    """

    bin: float
    start: list[float]
    count: list[Count]

    @model_validator(mode="after")
    def _fit_together(self) -> Self:
        if len(self.start) != len(self.count):
            raise ValueError("a histogram must have as many counts as bins")
        return self


class HoldingTime(Section):
    """Seconds for which a constraint holds, and the probability that it holds throughout.

    Attributes:
        mean: of all flights.
        worst_1_sigma: the quantile that 84 % of flights exceed.
        worst_2_sigma: the quantile that 98 % of flights exceed.
        throughout: probability that it holds in the whole window.
        histogram: of the flights' times.
    """

    mean: Interval
    worst_1_sigma: Interval
    worst_2_sigma: Interval
    throughout: Interval
    histogram: Histogram


class Statistics(Section):
    """Mean and 5 % and 95 % quantiles over the flights that have a quantity; none if no flight has.

    Attributes:
        samples: flights that have the quantity.
        mean: of them.
        q05: 5 % quantile.
        q95: 95 % quantile.
    """

    samples: Count
    mean: Interval | None = None
    q05: Interval | None = None
    q95: Interval | None = None

    @model_validator(mode="after")
    def _whole(self) -> Self:
        if self.samples and None in (self.mean, self.q05, self.q95):
            raise ValueError("a spread of samples must have mean, q05 and q95")
        return self


class ClosestApproach(Statistics):
    """Distance from the body's centre, m; `worst` is its 0.3 % quantile."""

    worst: Interval


class Normality(Section):
    """D'Agostino and Pearson's test, and the quantiles of the standardised component at `levels`.

    Attributes:
        samples: values that were tested.
        p_value: of the test; small if the values are hardly normal.
        levels: of the quantiles.
        quantiles: of the standardised component.
    """

    samples: Count
    p_value: float
    levels: list[float]
    quantiles: list[float]

    @model_validator(mode="after")
    def _fit_together(self) -> Self:
        if len(self.levels) != len(self.quantiles):
            raise ValueError("there must be as many quantiles as levels")
        return self


class Terminal(Section):
    """Final state by component with a spread: sampled over predicted sigma, and normality.

    Attributes:
        sigma_ratio: sampled over predicted sigma, by component.
        normality: of each component.
        sigma_position_m: root of the position's summed variances.
        sigma_velocity_m_s: the same of the velocity.
    """

    sigma_ratio: ByName[Interval]
    normality: ByName[Normality]
    sigma_position_m: Interval
    sigma_velocity_m_s: Interval

    @property
    def missed(self) -> str | None:
        """See `missed_by_law`."""
        values = {name: ratio.value for name, ratio in self.sigma_ratio.items()}
        return missed_by_law({name: value for name, value in values.items() if value is not None})


class CorrectedBurn(Section):
    """Probability that a corrected burn, as it is commanded, keeps each limit on burns.

    Attributes:
        burn: its number in the flight, from 1.
        cut_off_s: of its measurement, past the epoch.
        limits: by name, each for itself.
        failed: flights that planned it again in vain; null where none plans again.
    """

    burn: Annotated[int, Field(ge=1)]
    cut_off_s: float
    limits: ByName[Interval]
    failed: Count | None = None


class Commanded(Section):
    """Statistics of the burns that a policy commands in flight.

    Attributes:
        mean_dv_m_s: of the sum of the commanded burns' sizes.
        dv99_m_s: its 99 % quantile, between two order statistics.
        burns: that are corrected.
    """

    mean_dv_m_s: Interval
    dv99_m_s: Interval
    burns: list[CorrectedBurn]


class Strata(Section):
    """Further flights, of which some lowest probabilities are: few of many draws.

    Attributes:
        draws: in all.
        flights: of them.
        names: of the probabilities that are theirs.
    """

    draws: Count
    flights: Count
    names: list[Line]


class Contingency(Section):
    """The way home after a missed burn, planned from the mean state there, and flown.

    Attributes:
        status: how the planning ended.
        total_dv_m_s: sum of its burns' sizes.
        burn_times_s: times of its burns, past the epoch of the plan in flight.
        burns_m_s: its burns, J2000.
        whole_flight: probability that a flight home keeps every limit throughout.
    """

    status: Line
    total_dv_m_s: float
    burn_times_s: tuple[float, ...]
    burns_m_s: tuple[tuple[float, float, float], ...] = ()
    whole_flight: Interval

    def __str__(self) -> str:
        """In words."""
        kept, times = self.whole_flight, ", ".join(f"{t:.0f}" for t in self.burn_times_s)
        return (
            f"then return: {self.status}, {mm_s(self.total_dv_m_s, 1)} by burns at {times} s; "
            f"flights home that keep every limit {kept.value:.4f}, {kept.low:.4f} to {kept.high:.4f}"
        )


class Summary(Displayed, File):
    """Results of many flights.

    Attributes:
        plan_hash: of the plan flown.
        samples: flights.
        seed: of their errors.
        truth: gravity that they felt, "planner", "harmonics" or "polyhedron".
        planned_gravity: with which the plan was made, in words.
        flown_gravity: that which they felt, in words.
        errors: model of the burns' errors, "componentwise" or "gates".
        policy: that commanded the burns, "open", "replan" or "feedback".
        confidence: of all intervals, 0.95.
        planned_dv_m_s: sum of the planned burns' sizes.
        window_s: observation window, past the epoch; null once it is over.
        held_s: time in the window for which each constraint holds, and `all` at once.
        entry_s: when flights first hold all at once, past the epoch.
        exit_s: when they last do.
        probability: of each joint constraint where it is lowest, safety distances in the whole flight
            and others in the window; and of `all` observation constraints at once.
        strata: further flights behind some of the probabilities, if any.
        whole_flight: probability that a flight keeps every limit throughout.
        closest_m: least distance from the body's centre.
        executed_dv_m_s: sum of the executed burns' sizes.
        commanded: burns as they are commanded in flight; absent where all are fixed before.
        terminal: final state.
        drift: after a burn that these flights miss; absent where none is missed.
        then: the way home after it, if asked for.
    """

    plan_hash: Line
    samples: Count
    seed: Count
    truth: TruthModel
    planned_gravity: Line
    flown_gravity: Line
    errors: ErrorModel
    policy: PolicyKind
    confidence: float
    planned_dv_m_s: float
    window_s: tuple[float, float] | None
    held_s: ByName[HoldingTime]
    entry_s: Statistics
    exit_s: Statistics
    probability: ByName[LowestProbability]
    strata: Strata | None = None
    whole_flight: Interval
    closest_m: ClosestApproach
    executed_dv_m_s: Statistics
    commanded: Commanded | None = None
    terminal: Terminal
    drift: DriftSafety | None = None
    then: Contingency | None = None

    @model_validator(mode="after")
    def _every_constraint(self) -> Self:
        if self.window_s is None:  # it was over where the flights began
            return self
        for name, found in (("held_s", self.held_s), ("probability", self.probability)):
            if not found.keys() >= {*SCIENCE, ALL}:
                raise ValueError(f"{name} must have {', '.join((*SCIENCE, ALL))}")
        return self

    def __str__(self) -> str:
        """Flights and settings, and each constraint's lowest probability."""
        policy = f", policy {self.policy}" if self.policy != "open" else ""
        flown = (
            f"{self.samples} flights, seed {self.seed}, {self.truth}, {self.errors} errors{policy}"
        )
        lines = [
            f"P({name}) {p.estimate.value:.4f}, {p.estimate.low:.4f} to {p.estimate.high:.4f}, "
            f"at {p.worst_t_s:.0f} s"
            for name, p in self.probability.items()
        ]
        return "\n".join([flown, *lines])

    def __repr__(self) -> str:
        """One line."""
        return f"<Summary: {str(self).partition(chr(10))[0]}>"

    def is_narrowed(self, name: str) -> bool:
        """Whether a probability is that of the further flights."""
        return self.strata is not None and name in self.strata.names

    def is_of(self, solution: Solution) -> bool:
        """Whether the solution's plan was flown."""
        return self.plan_hash == solution.plan_hash

    def write(self, folder: Path, name: str = FILE_NAME) -> Path:
        """Write it into a folder, whole or not at all.

        Raises:
            OSError: if the folder cannot be written.
        """
        # What was not set is the rest of a spread of no flights.
        entries: dict[str, Any] = self.model_dump(mode="json", exclude_unset=True)
        text = json.dumps({"schema": SCHEMA, **entries}, allow_nan=False)
        return write_atomically(folder / name, text + "\n")


def missed_by_law(ratios: Mapping[str, float]) -> str | None:
    """What the linear law misses of the spread after the last burn, by axis; None if nothing much.

    Ratios are sampled over predicted sigma, by component of the final state in J2000.
    """
    wider = [f"{name} {ratio:.2f}" for name, ratio in ratios.items() if ratio > WIDER]
    if not wider:
        return None
    return (
        "after the last burn flights spread more than by the linear law's covariance: sigma over the "
        f"predicted one {', '.join(wider)} in J2000, expected at most {WIDER:g}"
    )


def read_summary(path: Path) -> Summary:
    """Read a summary, or the one in a folder.

    Raises:
        InputError: if there is none, or it is damaged or of another version.
    """
    return read_file(path / FILE_NAME if path.is_dir() else path, Summary, SCHEMA, "summary")
