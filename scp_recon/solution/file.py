"""The solution file: its schema, and how it is written whole or not at all.

SI units, J2000, body-centred. `docs/solution_file.md` describes every key.
"""

from __future__ import annotations

import hashlib
import itertools
import json
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Any, Literal, Self

import numpy as np
import numpy.typing as npt
from pydantic import AliasChoices, Field, model_validator

from scp_recon.files import write_atomically
from scp_recon.scenario.fields import Line, Speed
from scp_recon.scenario.schema import Scenario
from scp_recon.scenario.warning import ScenarioWarning
from scp_recon.solution.parent import ParentPlan
from scp_recon.solution.part import File, Part
from scp_recon.solution.primer import Primer
from scp_recon.solution.risk import Risk
from scp_recon.solution.verdict import Verification

SCHEMA, READABLE = "scp_recon.solution/2", ("scp_recon.solution/1", "scp_recon.solution/2")
"""What is written and what is read; /1 called a worst margin `worst_margin_m_or_rad`."""
FILE_NAME = "solution.json"
HASH = "plan_hash"
"""Key of the hash with which a file was written, and what has failed where it is another plan's now."""
Number = Annotated[float, Field(ge=-1e30, le=1e30)]
"""A number to compute with: small enough that its square and quotients stay finite."""
Direction = Annotated[tuple[Number, Number, Number], Field(strict=False)]
"""A list is accepted too; its entries still have to be numbers."""


class Burn(Part):
    """An impulse."""

    t_s: float
    dv_m_s: tuple[Speed, Speed, Speed]


class Nodes(Part):
    """Mean and covariance on the grid, after the burn where one falls on the node."""

    t_s: list[Number]
    state: list[list[Number]]
    covariance: list[list[list[Number]]]

    @model_validator(mode="after")
    def _fit_together(self) -> Self:
        n = len(self.t_s)
        if n < 2 or any(b <= a for a, b in itertools.pairwise(self.t_s)):
            raise ValueError("nodes.t_s must be at least two ascending times")
        if len(self.state) != n or any(len(state) != 6 for state in self.state):
            raise ValueError(f"nodes.state must hold 6 numbers for each of {n} times")
        rows = [row for matrix in self.covariance for row in matrix]
        square = all(len(matrix) == 6 for matrix in self.covariance)
        if len(self.covariance) != n or not square or any(len(row) != 6 for row in rows):
            raise ValueError(f"nodes.covariance must hold 6 by 6 numbers for each of {n} times")
        return self


class FacetTable(Part):
    """Facets n'y <= offset of P2, one row each; `node` counts from 0."""

    constraint: list[Line]
    node: list[Annotated[int, Field(ge=0)]]
    normal: list[Direction]
    offset_m: list[Number]
    quantile: list[Number]

    @model_validator(mode="after")
    def _fit_together(self) -> Self:
        if len({len(column) for _, column in self}) != 1:
            raise ValueError("facets must have columns of one length")
        return self


class StageSummary(Part):
    """One run of the SCP."""

    name: Line
    status: Line
    total_dv_m_s: float
    iterations: int


class ConstraintResult(Part):
    """The smallest margin of a constraint, >= 0 where satisfied.

    In P2 the margin of a state constraint is what is left of the distance to the facet after the
    quantile times the standard deviation; in P3 the mean's distance to the region.
    """

    name: Line
    kind: Literal["keep_in", "keep_out", "burn", "joint", "covariance"]
    worst_margin: Annotated[
        float, Field(validation_alias=AliasChoices("worst_margin", "worst_margin_m_or_rad"))
    ]
    unit: Literal["m", "m/s", "sigma"]
    worst_t_s: float
    facets: int


class ViolationAmount(Part):
    """What the buffers of one constraint hold."""

    max: Annotated[float, Field(ge=0)]
    total: Annotated[float, Field(ge=0)]
    unit: Literal["m", "m/s", "sigma"]


class Violation(Part):
    """What all buffers hold; velocities count as metres over one unit of time."""

    max: Annotated[float, Field(ge=0)]
    total: Annotated[float, Field(ge=0)]
    by_constraint: dict[Line, ViolationAmount]


class IterationRecord(Part):
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


class TimingSummary(Part):
    """Seconds."""

    total: float
    setup: float
    linearise: float
    canonicalise: float
    conic_solver: float
    other: float


class UnitScales(Part):
    """Units in which violations of different kinds are compared."""

    length_m: float
    time_s: float


class LocalOptimum(Part):
    """Where some of several starts ended; numbers of starts, 0 the initial guess."""

    problem: Literal["P3", "P2"]
    status: Line
    total_dv_m_s: Number
    burns_m_s: list[tuple[Number, Number, Number]]
    starts: list[Annotated[int, Field(ge=0)]]


class StartsSummary(Part):
    """Several starts, of which the plan is the best: distinct local optima, P3's first."""

    number: Annotated[int, Field(ge=2)]
    seed: Annotated[int, Field(ge=0)]
    optima: list[LocalOptimum]


class Solution(File):
    """Everything about one plan; its file can be solved again from itself.

    Older files say no `method`.
    """

    status: Line
    message: Line
    problem: Literal["P3", "P2"]
    init: str
    method: Literal["scp", "ipopt", "none"] | None = None
    formulation: Line
    algorithm: Line
    solver: Line
    total_dv_m_s: Number
    burns: list[Burn]
    nodes: Nodes
    stages: list[StageSummary]
    constraints: list[ConstraintResult]
    facets: FacetTable | None = None
    risk: Risk | None = None
    starts: StartsSummary | None = None
    parent: ParentPlan | None = None
    primer: Primer | None = None
    violation: Violation
    iterations: list[IterationRecord]
    timing_s: TimingSummary
    units: UnitScales
    verification: Verification | None
    warnings: tuple[ScenarioWarning, ...] = ()
    scenario: Scenario

    @model_validator(mode="after")
    def _burns_of_scenario(self) -> Self:
        if len(self.burns) != len(self.scenario.burn_times_s):
            raise ValueError("there must be as many burns as the scenario has firing times to plan")
        return self

    @property
    def burns_m_s(self) -> npt.NDArray[np.float64]:
        """Burns as an array, shape (m, 3)."""
        return np.array([burn.dv_m_s for burn in self.burns])

    @property
    def flown_m_s(self) -> npt.NDArray[np.float64]:
        """Burns flown before the plan begins, shape (k, 3)."""
        flight = self.scenario.in_flight
        return np.array([] if flight is None else flight.flown_m_s).reshape(-1, 3)

    @property
    def plan_hash(self) -> str:
        """SHA-256 of scenario and burns, to the last bit, in hexadecimal; of nothing else."""
        return plan_hash(self.scenario, self.burns)

    def write(self, folder: Path, name: str = FILE_NAME) -> Path:
        """Write it into a folder; an old file stays whole until the new one is.

        Args:
            folder: which is there.
            name: of the file.

        Raises:
            OSError: if the folder cannot be written.
        """
        return write_atomically(folder / name, self.text())

    def text(self) -> str:
        """What the file holds: an entry a line."""
        entries: dict[str, Any] = {"schema": SCHEMA, HASH: self.plan_hash}
        entries |= self.model_dump(mode="json")
        lines = [f"{json.dumps(key)}: {json.dumps(value)}" for key, value in entries.items()]
        return "{\n" + ",\n".join(lines) + "\n}\n"


def plan_hash(scenario: Scenario, burns: Sequence[Burn]) -> str:
    """See `Solution.plan_hash`."""
    plan = {
        "scenario": scenario.model_dump(mode="json", exclude_defaults=True),
        "burns": [burn.model_dump(mode="json") for burn in burns],
    }
    canonical = json.dumps(plan, sort_keys=True, allow_nan=False)
    return hashlib.sha256(canonical.encode()).hexdigest()
