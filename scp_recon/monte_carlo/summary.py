"""What many flights found: the model of `montecarlo.json`, as it is written and read. SI."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Annotated, Any, Self, TypeVar

import numpy as np
from pydantic import Field, model_validator

from scp_recon.files import write_atomically
from scp_recon.monte_carlo.estimates import Estimate
from scp_recon.monte_carlo.observation_time import ALL, SCIENCE
from scp_recon.monte_carlo.sampling import ErrorModel, TruthModel
from scp_recon.scenario.fields import Line
from scp_recon.solution.file import Solution
from scp_recon.solution.part import File, Part, read_file

SCHEMA = "scp_recon.montecarlo/1"
FILE_NAME = "montecarlo.json"

COMPONENTS = ("x", "y", "z", "vx", "vy", "vz")
"""Of the final state, J2000."""

Count = Annotated[int, Field(ge=0)]


class Interval(Part):
    """A value and its confidence interval; null where JSON has no number, as of an open end."""

    value: float | None
    low: float | None
    high: float | None

    @property
    def estimate(self) -> Estimate:
        """With an infinite open end, and NaN for no value."""
        return Estimate(
            np.nan if self.value is None else self.value,
            -np.inf if self.low is None else self.low,
            np.inf if self.high is None else self.high,
        )


class LowestProbability(Interval):
    """Of a joint constraint, at the time when it is smallest."""

    worst_t_s: float


class Histogram(Part):
    """The bins of one width that hold anything: where they start, and how many flights each."""

    bin: float
    start: list[float]
    count: list[Count]

    @model_validator(mode="after")
    def _fit_together(self) -> Self:
        if len(self.start) != len(self.count):
            raise ValueError("a histogram must have as many counts as bins")
        return self


class Held(Part):
    """Seconds in which a constraint holds, and the probability that it does throughout."""

    mean: Interval
    worst_1_sigma: Interval
    worst_2_sigma: Interval
    throughout: Interval
    histogram: Histogram


class Spread(Part):
    """Mean and 5 % and 95 % quantiles of the flights that have the quantity; without any, no more."""

    samples: Count
    mean: Interval | None = None
    q05: Interval | None = None
    q95: Interval | None = None

    @model_validator(mode="after")
    def _whole(self) -> Self:
        if self.samples and None in (self.mean, self.q05, self.q95):
            raise ValueError("a spread of samples must have mean, q05 and q95")
        return self


class ClosestApproach(Spread):
    """Distance from the body's centre, m; `worst` is its 0.3 % quantile."""

    worst: Interval


class Normality(Part):
    """D'Agostino and Pearson's test, and the quantiles of the standardised component at `levels`."""

    samples: Count
    p_value: float
    levels: list[float]
    quantiles: list[float]

    @model_validator(mode="after")
    def _fit_together(self) -> Self:
        if len(self.levels) != len(self.quantiles):
            raise ValueError("there must be as many quantiles as levels")
        return self


class Terminal(Part):
    """Final state by component, those that spread: sampled over predicted sigma, and normality."""

    sigma_ratio: dict[Line, Interval]
    normality: dict[Line, Normality]


class Summary(File):
    """Everything many flights found; `plan_hash` is that of the plan flown, null in older files."""

    plan_hash: Line | None = None
    samples: Count
    seed: Count
    truth: TruthModel
    errors: ErrorModel
    confidence: float
    planned_dv_m_s: float
    window_s: tuple[float, float] | None
    held_s: dict[Line, Held]
    entry_s: Spread
    exit_s: Spread
    probability: dict[Line, LowestProbability]
    whole_flight: Interval | None = None
    closest_m: ClosestApproach
    executed_dv_m_s: Spread
    terminal: Terminal

    @model_validator(mode="after")
    def _every_constraint(self) -> Self:
        if self.window_s is None:  # it was over where the flights began
            return self
        for name, found in (("held_s", self.held_s), ("probability", self.probability)):
            if not found.keys() >= {*SCIENCE, ALL}:
                raise ValueError(f"{name} must have {', '.join((*SCIENCE, ALL))}")
        return self

    def __str__(self) -> str:
        """What was flown, and each constraint's probability where it is lowest."""
        flown = f"{self.samples} flights, seed {self.seed}, {self.truth}, {self.errors} errors"
        lines = [
            f"P({name}) {p.estimate.value:.4f}, {p.estimate.low:.4f} to {p.estimate.high:.4f}, "
            f"at {p.worst_t_s:.0f} s"
            for name, p in self.probability.items()
        ]
        return "\n".join([flown, *lines])

    def __repr__(self) -> str:
        """One line."""
        return f"<Summary: {str(self).partition(chr(10))[0]}>"

    def is_of(self, solution: Solution) -> bool:
        """Whether it was the solution's plan that was flown."""
        return self.plan_hash == solution.plan_hash

    def write(self, folder: Path) -> Path:
        """Write `montecarlo.json` into a folder, whole or not at all.

        Raises:
            OSError: if the folder cannot be written.
        """
        # What was not set is the rest of a spread of no flights.
        entries: dict[str, Any] = self.model_dump(mode="json", exclude_unset=True)
        text = json.dumps({"schema": SCHEMA, **entries}, allow_nan=False)
        return write_atomically(folder / FILE_NAME, text + "\n")


Kind = TypeVar("Kind", bound=Summary)


def read_summary(path: Path) -> Summary:
    """Read a summary, or the one in a folder.

    Raises:
        InputError: if there is none, it is of another version, or it is damaged.
    """
    return read_summary_as(Summary, path)


def read_summary_as(kind: type[Kind], path: Path) -> Kind:
    """Read a summary to which a study has added entries of its own, as `read_summary` does."""
    return read_file(path / FILE_NAME if path.is_dir() else path, kind, [SCHEMA], "summary")
