"""The facts of a plan as its file stores them; SI, J2000, body-centred.

Margins, violation and totals are no facts: `figures` computes them from these. `docs/solution_file.md`
describes every key. What planning records of its making (certificate, starts, the plan before, the
primer) is stored as planning's own data classes. Where a field's name is not the file's key, the key
stands as its alias.
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass
from functools import cache
from typing import Annotated, Any, ClassVar, Literal

import numpy as np
from pydantic import ConfigDict, Field, TypeAdapter
from scipy.special import ndtri

from formulations.arrays import Array
from scp_recon.planning.plan import Certificate, Parent, Starts
from scp_recon.planning.primer import PrimerHistory
from scp_recon.scenario.fields import Line, Number, Probability, ScenarioWarning, Speed
from scp_recon.scenario.schema import Scenario
from scp_recon.scp.loop import Timing

Direction = Annotated[tuple[Number, Number, Number], Field(strict=False)]
"""A list is accepted too; its entries still have to be numbers."""
SURE = 1e-16
"""Least probability, and most less one, whose quantile is finite."""


@dataclass(frozen=True)
class Burn:
    """An impulse."""

    t_s: float
    dv_m_s: tuple[Speed, Speed, Speed]


@dataclass(frozen=True)
class Nodes:
    """Mean and covariance on the grid, after the burn where one falls on the node."""

    t_s: list[Number]
    state: list[list[Number]]
    covariance: list[list[list[Number]]]

    def __post_init__(self) -> None:
        """Refuse what does not fit together."""
        n = len(self.t_s)
        if n < 2 or any(b <= a for a, b in itertools.pairwise(self.t_s)):
            raise ValueError("nodes.t_s must be at least two ascending times")
        if len(self.state) != n or any(len(state) != 6 for state in self.state):
            raise ValueError(f"nodes.state must hold 6 numbers for each of {n} times")
        rows = [row for matrix in self.covariance for row in matrix]
        square = all(len(matrix) == 6 for matrix in self.covariance)
        if len(self.covariance) != n or not square or any(len(row) != 6 for row in rows):
            raise ValueError(f"nodes.covariance must hold 6 by 6 numbers for each of {n} times")


@dataclass(frozen=True)
class FacetTable:
    """Facets n'y <= offset of P2, one row each; `node` counts from 0."""

    constraint: list[Line]
    node: list[Annotated[int, Field(ge=0)]]
    normal: list[Direction]
    offset_m: list[Number]
    quantile: list[Number]

    def __post_init__(self) -> None:
        """Refuse columns that do not fit together."""
        if len({len(column) for column in vars(self).values()}) != 1:
            raise ValueError("facets must have columns of one length")


@dataclass(frozen=True)
class StageSummary:
    """One run of the SCP."""

    name: Line
    status: Line
    total_dv_m_s: float
    iterations: int


@dataclass(frozen=True)
class IterationRecord:
    """One SCP iteration: merits in m/s, radius in m/s, violation and defect in m."""

    stage: Line
    k: int
    merit: float
    predicted: float
    actual: float
    accepted: bool
    trust_radius: float
    max_violation: float
    max_defect: float
    solver_s: float


@dataclass(kw_only=True)
class PlanTiming(Timing):
    """Seconds of all stages: in total, by what they were spent on, and what is left."""

    total: float
    other: float


@dataclass(frozen=True)
class EventProbability:
    """A joint constraint by the normal law, at its nodes; of a whole flight just one.

    `sigma` are the probabilities' normal quantiles, which differ where probabilities are one to the
    last digit; older files have none.
    """

    name: Line
    t_s: list[float]
    probability: list[Probability]
    sigma: list[Number] | None = None

    def __post_init__(self) -> None:
        """Refuse columns that do not fit together."""
        lengths = {len(self.t_s), len(self.probability), len(self.sigma or self.probability)}
        if len(lengths) != 1 or not self.t_s:
            raise ValueError("there must be as many probabilities as times, and at least one")

    @property
    def quantiles(self) -> Array:
        """Normal quantiles, finite ones."""
        if self.sigma is not None:
            return np.array(self.sigma)
        return np.asarray(ndtri(np.clip(self.probability, SURE, 1.0 - SURE)))


@dataclass(frozen=True)
class Risk:
    """The risk of an exact plan, of each node or of the whole flight: required and targeted.

    Without a certificate no flights stand behind it.
    """

    scope: Literal["node", "flight"]
    required: Annotated[Probability, Field(alias="asked")]
    target: Annotated[Probability, Field(alias="aim")]
    certificate: Certificate | None
    normal_law: list[EventProbability]


@dataclass(frozen=True)
class MeanMargin:
    """Margin of an original constraint for the mean, between the nodes too."""

    name: str
    worst_margin: float
    unit: Literal["m", "rad", "m/s"]
    worst_t_s: float


@dataclass(frozen=True)
class JointProbability:
    """Probability of a joint constraint at the time when it is smallest, by Monte Carlo."""

    name: str
    worst_t_s: float
    estimate: Probability
    low: Probability
    high: Probability


@dataclass(frozen=True)
class FinalMiss:
    """By how much the final state is missed, where the burns left are too few to meet it.

    `weighted_m_s` is what the plan charges for it, beside its delta-v.
    """

    position_m: float
    velocity_m_s: float
    weighted_m_s: float

    def __str__(self) -> str:
        """In words."""
        return (
            f"the final state is missed by {self.position_m:.4g} m and {self.velocity_m_s:.4g} m/s: "
            "too few burns are left to meet it"
        )


@dataclass(frozen=True)
class FinalSigma:
    """A limit on the covariance after the last burn, and what nonlinear flights reach of it.

    Root of the summed variances of the three components; `error` is one standard error.
    """

    name: str
    unit: Literal["m", "m/s"]
    required: Annotated[float, Field(alias="asked")]
    flown: float
    error: float

    def __str__(self) -> str:
        """In words."""
        return (
            f"{self.name} of flights {self.flown:.4g} +- {self.error:.2g} {self.unit}, "
            f"asked at most {self.required:g}"
        )


@dataclass(frozen=True, kw_only=True, repr=False)
class Verification:
    """An independent look at the result; `failed` names what keeps it from being ok."""

    terminal_position_error_m: float
    terminal_velocity_error_m_s: float
    max_defect: float
    sample_error_m: float
    covariance_error: float
    mean_margins: list[MeanMargin]
    samples: int
    confidence: float
    probabilities: list[JointProbability]
    failed: list[str]
    missed: FinalMiss | None = None
    final_sigmas: tuple[FinalSigma, ...] = ()
    ok: bool

    def __str__(self) -> str:
        """The verdict, and the lowest probabilities."""
        lines = ["verified" if self.ok else f"not verified: {', '.join(self.failed)}"]
        lines += [str(self.missed)] if self.missed else []
        lines += [str(sigma) for sigma in self.final_sigmas]
        lines += [
            f"P({p.name}) {p.estimate:.4f}, {p.low:.4f} to {p.high:.4f}, at {p.worst_t_s:.0f} s"
            for p in self.probabilities
        ]
        return "\n".join(lines)

    def __repr__(self) -> str:
        """One line."""
        return f"<Verification: {str(self).partition(chr(10))[0]}>"


@dataclass(frozen=True, kw_only=True)
class Facts:
    """Everything that is stored of a plan; its file can be solved again from itself.

    Older files say neither `method` nor `tolerance`, the violation in units of the nondimensional
    problem that counted as none.
    """

    __pydantic_config__: ClassVar[ConfigDict] = ConfigDict(
        strict=True, extra="forbid", allow_inf_nan=False
    )

    status: Line
    message: Line
    problem: Literal["P3", "P2"]
    init: str
    method: Literal["scp", "ipopt", "none"] | None = None
    formulation: Line
    algorithm: Line
    solver: Line
    tolerance: Annotated[float, Field(ge=0, le=1)] | None = None
    burns: list[Burn]
    nodes: Nodes
    stages: list[StageSummary]
    facets: FacetTable | None = None
    risk: Risk | None = None
    starts: Starts | None = None
    parent: Parent | None = None
    primer: PrimerHistory | None = None
    iterations: list[IterationRecord]
    timing_s: PlanTiming
    verification: Verification | None
    warnings: tuple[ScenarioWarning, ...] = ()
    scenario: Scenario

    def __post_init__(self) -> None:
        """Refuse burns that are not the scenario's."""
        if len(self.burns) != len(self.scenario.burn_times_s):
            raise ValueError("there must be as many burns as the scenario has firing times to plan")


@cache
def adapter(kind: Any) -> TypeAdapter[Any]:
    """The strict converter between JSON and a data class: made once, when it is first needed."""
    return TypeAdapter(kind)
