"""Define the facts of a plan that its file stores; SI, J2000, body-centred.

Margins, violation and totals are not facts: `figures` computes them from the facts.
`docs/solution_file.md` describes every key. Records of planning (certificate, starts, parent,
primer) are stored in the form of their data classes. A field whose name differs from the file's key
has the key as its alias.
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass
from functools import cache
from typing import Annotated, Any, ClassVar, Literal

import numpy as np
from pydantic import ConfigDict, Field, TypeAdapter

from formulations.arrays import Array
from scp_recon.display import mm_s
from scp_recon.planning.primer import PrimerHistory
from scp_recon.planning.records import Certificate, Parent, Starts, WithoutUncertainty
from scp_recon.results.policy import StoredPolicy, has_shape
from scp_recon.results.verification import Verification
from scp_recon.scenario.fields import Line, Number, Probability, ScenarioWarning, Speed
from scp_recon.scenario.schema import Scenario
from scp_recon.scp.loop import Timing
from scp_recon.scp.status import Status

Direction = Annotated[tuple[Number, Number, Number], Field(strict=False)]
"""A list is accepted too; its entries still have to be numbers."""


@dataclass(frozen=True)
class Burn:
    """A planned impulse.

    Attributes:
        t_s: time past the epoch.
        dv_m_s: velocity that it adds; three zeros where it would be too small to execute.
    """

    t_s: float
    dv_m_s: tuple[Speed, Speed, Speed]


@dataclass(frozen=True)
class Nodes:
    """Mean and covariance on the grid, after the burn where one falls on the node.

    Attributes:
        t_s: times of the n nodes past the epoch.
        state: position in m and velocity in m/s, n x 6.
        covariance: of these, n x 6 x 6: how far flights are off the mean.
        knowledge: covariance of the estimated state's errors, of a plan with feedback, n x 6 x 6: after
            the measurement where one is made on the node.
        parameters: covariance of the state with each of the p independent standard normal numbers that
            the uncertain parameters of the scenario's `knowledge` are made of, n x 6 x p.
    """

    t_s: list[Number]
    state: list[list[Number]]
    covariance: list[list[list[Number]]]
    knowledge: list[list[list[Number]]] | None = None
    parameters: list[list[list[Number]]] | None = None

    def __post_init__(self) -> None:
        """Refuse times that do not ascend, and arrays of other shapes."""
        n = len(self.t_s)
        if n < 2 or any(b <= a for a, b in itertools.pairwise(self.t_s)):
            raise ValueError("nodes.t_s must be at least two ascending times")
        for name, *shape in (("state", 6), ("covariance", 6, 6), ("knowledge", 6, 6)):
            given = getattr(self, name)
            if given is not None and not has_shape(given, n, *shape):
                size = " by ".join(map(str, shape))
                raise ValueError(f"nodes.{name} must hold {size} numbers for each of {n} times")


@dataclass(frozen=True)
class FacetTable:
    """Facets of P2: `normal . r + quantile * deviation <= offset_m` holds at the node.

    Attributes:
        constraint: name of the constraint, for each facet.
        node: its node, counted from 0.
        normal: outward normal of the half-space.
        offset_m: the facet's, along its normal.
        quantile: normal quantile of its share of the risk.
    """

    constraint: list[Line]
    node: list[Annotated[int, Field(ge=0)]]
    normal: list[Direction]
    offset_m: list[Number]
    quantile: list[Number]

    def __post_init__(self) -> None:
        """Refuse columns that do not fit together."""
        if len({len(column) for column in vars(self).values()}) != 1:
            raise ValueError("facets must have columns of one length")


STAGES = {
    "b": "begun again at the ballistic arc",
    "c": "begun again at a turn about the body, the shorter way",
    "d": "begun again at a turn about the body, the longer way",
    "open": "leads to P3 from a guess that is no flight",
    "node": "each node by itself, which leads to whole flights",
    "coarse": "whole flights by few sampled directions, which leads to all of them",
    "led": "leads to corrected burns where nothing else has a plan",
    "grown": "drifts keep out of a smaller ball, which leads out of the whole one",
    "held": "burns that would be too small to execute are left out or raised",
    "ptr": "solved by PTR, where SCvx ended badly",
    "scvx-star": "solved by SCvx*, where SCvx ended badly",
    "settled": "facets chosen again along the plans they allow, until none is cheaper",
}
"""Endings of stages' names in words."""


@dataclass(frozen=True)
class StageSummary:
    """One run of the SCP.

    Attributes:
        name: `P3` or `P2`, and endings: `P2.2` with facets chosen a second time, and so on; `P3b`,
            `P2.settled` and others as the report's table of stages explains them.
        status: how it ended.
        total_dv_m_s: sum of its burns' sizes.
        iterations: their number.
    """

    name: Line
    status: Line
    total_dv_m_s: float
    iterations: int

    @property
    def meaning(self) -> str:
        """Meaning of the name's ending; empty for plain P3 and P2."""
        again, *rest = self.name[2:].split(".")
        said = [
            f"choice {end} of the facets" if end.isdecimal() else STAGES.get(end) for end in rest
        ]
        return "; ".join(words for words in (STAGES.get(again), *said) if words)


@dataclass(frozen=True)
class IterationRecord:
    """One SCP iteration; velocities count as metres per unit of time in violation and defect.

    Attributes:
        stage: name of the stage.
        k: its number in the stage, from 1.
        merit: cost and penalties of the iterate, m/s.
        predicted: reduction of the merit by the convex model, m/s.
        actual: reduction of the merit, m/s.
        accepted: whether the step was accepted.
        trust_radius: bound on the change of a burn's component, m/s.
        max_violation: largest violation, m.
        max_defect: largest gap between arcs, m.
        solver_s: seconds in the conic solver.
    """

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
    """Seconds of all stages, of the kept start.

    By IPOPT: building and compiling, derivatives, 0, IPOPT itself, the rest.

    Attributes:
        total: from beginning to end.
        other: the rest of it.
    """

    total: float
    other: float


@dataclass(frozen=True)
class EventProbability:
    """Probabilities of a joint constraint by the normal law, at its nodes; one for a whole flight.

    Attributes:
        name: of the constraint, or `whole_flight`.
        t_s: times of its nodes.
        probability: that the constraint holds there.
        sigma: normal quantiles of the probabilities, which differ even where these round to one.
    """

    name: Line
    t_s: list[float]
    probability: list[Probability]
    sigma: list[Number]

    def __post_init__(self) -> None:
        """Refuse columns that do not fit together."""
        lengths = {len(self.t_s), len(self.probability), len(self.sigma)}
        if len(lengths) != 1 or not self.t_s:
            raise ValueError("there must be as many probabilities as times, and at least one")


@dataclass(frozen=True)
class Risk:
    """The risk of an exact plan.

    Attributes:
        scope: whether each node or the whole flight is meant.
        required: probability required.
        target: probability of the plan's rows.
        certificate: probability that nonlinear flights reached; absent if none certified the plan.
        normal_law: probabilities by the normal law.
    """

    scope: Literal["node", "flight"]
    required: Annotated[Probability, Field(alias="asked")]
    target: Probability
    certificate: Certificate | None
    normal_law: list[EventProbability]


@dataclass(frozen=True, kw_only=True)
class Facts:
    """Everything that is stored of a plan; its file is enough to solve it again.

    Attributes:
        status: `converged`, `infeasible`, `max_iterations`, `stalled`, `solver_failed`, `lost` (a plan
            made in flight, which misses the final state) or `interrupted`.
        message: the status in words, and what to try next.
        problem: `P2`, or `P3` where planning ended before P2.
        init: initial guess: `cold`, `warm`, a file.
        method: `none` where nothing was optimised.
        formulation: of the convex program, or variant of the nonlinear one.
        algorithm: of sequential convex programming.
        solver: conic solver.
        tolerance: violation in units of the nondimensional problem that counts as none: 1e-6, of whole
            flights 1e-5, in a stage that leads to them 1e-3.
        burns: burns planned; earlier ones stand in `scenario.in_flight.flown_m_s`.
        nodes: mean and covariance of the flight.
        stages: one for each run of the SCP.
        facets: of P2, absent from P3 and with exact risk.
        risk: of an exact plan.
        policy: of a plan with feedback; absent from others.
        starts: of a plan that is the best of several starts.
        parent: of a plan made in flight.
        without_uncertainty: the cheapest P3 that planning found; absent where it began at a plan.
        primer: of a converged plan whose errors shrink with the burns.
        iterations: one for each iteration of each stage.
        timing_s: time it took.
        verification: absent if the run was interrupted.
        warnings: entries that are allowed but unlikely.
        advice: of an infeasible plan the binding limits and options that were tried and work; of a
            verified one what exact risk would save; as the command line printed it.
        scenario: the whole validated input, with the numbers computed from shapes, kernels and gravity
            files ([entries](scenario.md)).
    """

    __pydantic_config__: ClassVar[ConfigDict] = ConfigDict(
        strict=True, extra="forbid", allow_inf_nan=False
    )

    status: Line
    message: Line
    problem: Literal["P3", "P2"]
    init: str
    method: Literal["scp", "ipopt", "none"]
    formulation: Line
    algorithm: Line
    solver: Line
    tolerance: Annotated[float, Field(ge=0, le=1)]
    burns: list[Burn]
    nodes: Nodes
    stages: list[StageSummary]
    facets: FacetTable | None = None
    risk: Risk | None = None
    policy: StoredPolicy | None = None
    starts: Starts | None = None
    parent: Parent | None = None
    without_uncertainty: WithoutUncertainty | None = None
    primer: PrimerHistory | None = None
    iterations: list[IterationRecord]
    timing_s: PlanTiming
    verification: Verification | None
    warnings: tuple[ScenarioWarning, ...] = ()
    advice: tuple[Line, ...] = ()
    scenario: Scenario

    @property
    def burns_m_s(self) -> Array:
        """Burns, J2000, m/s, shape (m, 3)."""
        return np.array([burn.dv_m_s for burn in self.burns]).reshape(-1, 3)

    @property
    def total_dv_m_s(self) -> float:
        """Sum of the burns' sizes, m/s."""
        return float(np.linalg.norm(self.burns_m_s, axis=1).sum())

    @property
    def cost_in_words(self) -> str:
        """What uncertainty and a single choice of facets cost beside the plan; empty if not known."""
        said = [] if self.problem == "P3" else [str(self.without_uncertainty or "")]
        by_name = {stage.name: stage for stage in self.stages}
        for name, stage in by_name.items():
            first = by_name.get(name.removesuffix(".settled"))
            if first is not None and first is not stage:
                once, settled = (
                    mm_s(one.total_dv_m_s)
                    if one.status == Status.CONVERGED.value.name
                    else one.status
                    for one in (first, stage)
                )
                once = once.removesuffix(" mm/s")
                said.append(f"P2 with P3's facets {once}, facets settled {settled}")
        return "; ".join(filter(None, said))

    def __post_init__(self) -> None:
        """Refuse burns whose number is not the scenario's."""
        if len(self.burns) != len(self.scenario.burn_times_s):
            raise ValueError("there must be as many burns as the scenario has firing times to plan")
        numbers = range(
            1 + self.scenario.burns_flown, 1 + self.scenario.burns_flown + len(self.burns)
        )
        if self.policy is not None and any(c.burn not in numbers for c in self.policy.corrections):
            raise ValueError("policy.corrections must be of burns that are planned")


@cache
def adapter(kind: Any) -> TypeAdapter[Any]:
    """The strict converter between JSON and a data class, made once, at first use."""
    return TypeAdapter(kind)
