"""The solution file: its schema, and how it is read and written whole or not at all.

SI units, J2000, body-centred. `docs/solution_file.md` describes every key.
"""

from __future__ import annotations

import itertools
import json
from pathlib import Path
from typing import Annotated, Any, Literal, Self

import numpy as np
import numpy.typing as npt
from pydantic import BaseModel, ConfigDict, Field, ValidationError, model_validator

from scp_recon.errors import InputError
from scp_recon.files import read_text, write_atomically
from scp_recon.mission.mission import Mission
from scp_recon.scenario.schema import Line, Scenario, Speed
from scp_recon.scp.status import Status

SCHEMA = "scp_recon.solution/1"
FILE_NAME = "solution.json"
TIME_ERROR_S = 1e-3
"""Far above how the edges of a window differ from one machine to another."""
Number = Annotated[float, Field(ge=-1e30, le=1e30)]
"""Of what is worked with: its square and its quotients stay finite."""


class Part(BaseModel):
    """Frozen; keys that are not known here are kept out."""

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)


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
    normal: list[tuple[Number, Number, Number]]
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
    kind: Literal["keep_in", "keep_out", "burn"]
    worst_margin_m_or_rad: float
    unit: Literal["m", "m/s"]
    worst_t_s: float
    facets: int


class ViolationAmount(Part):
    """What the buffers of one constraint hold."""

    max: Annotated[float, Field(ge=0)]
    total: Annotated[float, Field(ge=0)]
    unit: Literal["m", "m/s"]


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


class MeanMargin(Part):
    """Margin of an original constraint for the mean, between the nodes too."""

    name: str
    worst_margin: float
    unit: Literal["m", "rad", "m/s"]
    worst_t_s: float


class JointProbability(Part):
    """Probability of a joint constraint at the time when it is smallest, by Monte Carlo."""

    name: str
    worst_t_s: float
    estimate: float
    low: float
    high: float


class Verification(Part):
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
    ok: bool


class UnitScales(Part):
    """Units in which violations of different kinds are compared."""

    length_m: float
    time_s: float


class Solution(Part):
    """Everything about one plan; its file can be solved again from itself."""

    model_config = ConfigDict(frozen=True, extra="ignore", allow_inf_nan=False)

    status: Line
    message: Line
    problem: Literal["P3", "P2"]
    init: str
    formulation: Line
    algorithm: Line
    solver: Line
    total_dv_m_s: Number
    burns: list[Burn]
    nodes: Nodes
    stages: list[StageSummary]
    constraints: list[ConstraintResult]
    facets: FacetTable | None = None
    violation: Violation
    iterations: list[IterationRecord]
    timing_s: TimingSummary
    units: UnitScales
    verification: Verification | None
    scenario: Scenario

    @model_validator(mode="after")
    def _burns_of_scenario(self) -> Self:
        if len(self.burns) != len(self.scenario.burns.times_s):
            raise ValueError("there must be as many burns as the scenario has firing times")
        return self

    @property
    def burns_m_s(self) -> npt.NDArray[np.float64]:
        """Burns as an array, shape (m, 3)."""
        return np.array([burn.dv_m_s for burn in self.burns])

    def write(self, folder: Path) -> Path:
        """Write `solution.json` into a folder; an old file stays whole until the new one is.

        Raises:
            OSError: if the folder cannot be written.
        """
        entries: dict[str, Any] = {"schema": SCHEMA, **self.model_dump(mode="json")}
        lines = [f"{json.dumps(key)}: {json.dumps(value)}" for key, value in entries.items()]
        return write_atomically(folder / FILE_NAME, "{\n" + ",\n".join(lines) + "\n}\n")


def read_solution(path: Path) -> Solution:
    """Read a solution file, or the one in a folder.

    Raises:
        InputError: if there is none, it is of another version, it is damaged, or its parts do not
            fit together.
    """
    file = path / FILE_NAME if path.is_dir() else path
    text = read_text(file, f"solution {file}", "solution file in JSON")
    try:
        data = json.loads(text)
    except (ValueError, RecursionError) as error:
        raise InputError(
            f"solution {file}", f"no JSON ({error})", "must be a solution file"
        ) from None
    if not isinstance(data, dict) or data.get("schema") != SCHEMA:
        given = data.get("schema", "no schema") if isinstance(data, dict) else "no object"
        raise InputError(f"solution {file}", repr(given), f"schema must be {SCHEMA!r}")
    try:
        # Through JSON again: strict fields such as tuples and dates read from it as written to it.
        solution = Solution.model_validate_json(json.dumps(data))
        Status.named(solution.status)
        mission = Mission.from_scenario(solution.scenario)
    except ValidationError as error:
        first = error.errors(include_url=False)[0]
        entry = ".".join(str(part) for part in first["loc"])
        given = repr(first["input"])[:80] if first["type"] != "missing" else "nothing"
        raise InputError(f"solution {file}: {entry}", given, first["msg"]) from None
    except InputError as error:  # of the scenario
        raise InputError(f"solution {file}: {error.entry}", error.given, error.allowed) from None
    except ValueError:
        allowed = ", ".join(status.value.name for status in Status)
        raise InputError(
            f"solution {file}: status", repr(data["status"]), f"must be one of {allowed}"
        ) from None
    _check(mission, solution, file)
    return solution


def _check(mission: Mission, solution: Solution, file: Path) -> None:
    """Hold a plan against what its scenario makes of grid and units, be it on another machine."""
    times, units, facets = solution.nodes.t_s, solution.units, solution.facets
    n, expected = len(mission.times_s), mission.units
    contradicts = {
        "burns": [b.t_s for b in solution.burns] != list(solution.scenario.burns.times_s),
        "nodes.t_s": len(times) != n
        or not np.allclose(times, mission.times_s, rtol=0.0, atol=TIME_ERROR_S),
        "facets.node": facets is not None and max(facets.node, default=0) >= n,
        "units": not np.allclose(
            [units.length_m, units.time_s], [expected.length_m, expected.time_s]
        ),
    }
    for entry in (entry for entry, does in contradicts.items() if does):
        raise InputError(
            f"solution {file}: {entry}", "what contradicts its scenario", "must be of one plan"
        )
