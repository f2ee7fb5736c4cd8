"""Hold a stored plan: its facts, the figures computed from them, and the text of its file."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Sequence
from dataclasses import asdict, dataclass, field, fields, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from scipy.special import ndtr, ndtri

from formulations.arrays import Array
from formulations.program.subproblem import MeritFunction
from formulations.rows.uniform import DeterministicRows
from scp_recon.display import Displayed, mm_s
from scp_recon.errors import InputError
from scp_recon.files import write_atomically
from scp_recon.mission.mission import Mission
from scp_recon.mission.scene import Units
from scp_recon.planning.plan import NOT_CHECKED, Plan, Provenance, Stage, StageSpec
from scp_recon.planning.primer import primer_of
from scp_recon.results.facts import (
    Burn,
    EventProbability,
    FacetTable,
    Facts,
    IterationRecord,
    Nodes,
    PlanTiming,
    Risk,
    StageSummary,
    adapter,
)
from scp_recon.results.figures import (
    ConstraintResult,
    Figures,
    Violation,
    figures_of,
    finite,
)
from scp_recon.results.policy import Policy, StoredPolicy, policy_in, stored_policy
from scp_recon.results.verification import Verification
from scp_recon.scenario.schema import Scenario
from scp_recon.scp.algorithms import SCvx
from scp_recon.scp.loop import Record, Result, Timing
from scp_recon.scp.status import Status

SCHEMA = "scp_recon.solution/4"
FILE_NAME = "solution.json"
HASH = "plan_hash"
"""Key of the hash with which a file was written, and what has failed where it is another plan's now."""
NOT_OPTIMISED = "none"
"""The `algorithm` of a solution file whose burns were given and only evaluated."""


@dataclass(frozen=True, kw_only=True, repr=False)
class Solution(Displayed, Facts):
    """A stored plan: its facts, and figures as properties computed from them on access.

    `carried` holds the figures that the file had; it is no part of the plan.
    """

    carried: Figures | None = field(default=None, compare=False)

    def __repr__(self) -> str:
        """One line."""
        verdict = self.verification.verdict if self.verification else NOT_CHECKED
        return f"<Solution {self.scenario.name}: {self.status}, {verdict}, {self.total_dv_m_s:.6f} m/s>"

    def __getstate__(self) -> dict[str, object]:
        """The fields without cached figures, which a copy computes again."""
        return {each.name: getattr(self, each.name) for each in fields(self)}

    @cached_property
    def mission(self) -> Mission:
        """The scenario resolved.

        Raises:
            InputError: as `Mission.from_scenario`.
        """
        return Mission.from_scenario(self.scenario).along(self.burns_m_s)

    @cached_property
    def figures(self) -> Figures:
        """All figures at once."""
        return figures_of(self.mission, self)

    @property
    def constraints(self) -> list[ConstraintResult]:
        """The smallest margin of each constraint."""
        return self.figures.constraints

    @property
    def violation(self) -> Violation:
        """Violations above the tolerance."""
        return self.figures.violation

    @property
    def units(self) -> Units:
        """Units of the nondimensional problem."""
        return self.mission.units

    @property
    def corrections(self) -> Policy:
        """Corrections of the burns as arrays; none where all burns are fixed before departure."""
        return policy_in(self.policy, self.scenario.burns_flown)

    @property
    def by_policy(self) -> str | None:
        """The next burn by the gains of the plan in flight alone, in words."""
        if self.parent is None or self.parent.commanded_m_s is None:
            return None
        burn, alone = self.burns[0], np.array(self.parent.commanded_m_s)
        apart = float(np.linalg.norm(np.array(burn.dv_m_s) - alone))
        return (
            f"the policy of {self.parent.name} alone would command burn "
            f"{1 + self.scenario.burns_flown} at {burn.t_s:g} s as "
            f"{' '.join(f'{1e3 * part:+.3f}' for part in alone)}, "
            f"{mm_s(float(np.linalg.norm(alone)))}; this plan differs by {mm_s(apart)}"
        )

    @property
    def executed(self) -> list[tuple[int, Burn]]:
        """Burns that are not zero, each with its number in the flight."""
        numbered = enumerate(self.burns, start=1 + self.scenario.burns_flown)
        return [(number, burn) for number, burn in numbered if any(burn.dv_m_s)]

    @property
    def flown_m_s(self) -> Array:
        """Burns flown before the plan begins, shape (k, 3)."""
        flight = self.scenario.in_flight
        return np.array([] if flight is None else flight.flown_m_s).reshape(-1, 3)

    @property
    def plan_hash(self) -> str:
        """SHA-256, hexadecimal, of scenario, burns and corrections alone, to the last bit."""
        return plan_hash(self.scenario, self.burns, self.policy)

    def with_verification(self, verification: Verification | None) -> Solution:
        """The same plan with a verification; its resolved mission is kept."""
        judged = replace(self, verification=verification)
        return _resolved(judged, self.__dict__.get("mission"))

    def document(self) -> dict[str, Any]:
        """The file's content without schema and hash: figures and facts, by the file's keys."""
        facts, figures = (
            adapter(kind).dump_python(value, mode="json", by_alias=True)
            for kind, value in ((Facts, self), (Figures, self.figures))
        )
        head = {key: facts[key] for key in ("status", "message", "problem")}
        return head | figures | facts

    def text(self) -> str:
        """The file's text: one top-level key a line.

        Raises:
            ValueError: if a number is not finite: JSON has none.
        """
        entries = {"schema": SCHEMA, HASH: self.plan_hash} | self.document()
        lines = [
            f"{json.dumps(key)}: {json.dumps(value, allow_nan=False)}"
            for key, value in entries.items()
        ]
        return "{\n" + ",\n".join(lines) + "\n}\n"

    def write(self, folder: Path, name: str = FILE_NAME) -> Path:
        """Write the file into an existing folder, atomically.

        Raises:
            OSError: if the folder cannot be written.
        """
        return write_atomically(folder / name, self.text())


def _resolved(solution: Solution, mission: Mission | None) -> Solution:
    """The same, with its mission where that is known."""
    if mission is not None:
        solution.__dict__["mission"] = mission  # where its cached property keeps it
    return solution


def plan_hash(scenario: Scenario, burns: Sequence[Burn], policy: StoredPolicy | None) -> str:
    """SHA-256 of burns, corrections if any, and of a scenario's tables without its defaults."""
    plan: dict[str, Any] = {
        "scenario": scenario.model_dump(mode="json", exclude_defaults=True),
        "burns": [{"t_s": burn.t_s, "dv_m_s": burn.dv_m_s} for burn in burns],
    }
    if policy is not None:
        plan["corrections"] = [asdict(correction) for correction in policy.corrections]
    canonical = json.dumps(plan, sort_keys=True, allow_nan=False)
    return hashlib.sha256(canonical.encode()).hexdigest()


def require_whole_flight(scenario: Scenario, entry: str) -> None:
    """Refuse a plan made in flight where a whole one is needed.

    Raises:
        InputError: if the plan begins in flight.
    """
    if scenario.in_flight is not None:
        raise InputError(
            entry,
            f"a plan from {scenario.start_s:g} s on, made in flight",
            "must be the plan of a whole flight",
        )


# --- from a plan --------------------------------------------------------------------------------


def make_solution(plan: Plan) -> Solution:
    """Make a solution, not yet verified, from a plan's facts in SI."""
    mission, outcome = plan.mission, plan.final.result.status.value
    policy, parts = stored_policy(plan), vars(plan.timing)
    solution = Solution(
        **vars(plan.provenance),
        status=outcome.name,
        message=outcome.message,
        problem=plan.final.problem,
        tolerance=plan.final.tolerance,
        burns=burns_of_plan(plan),
        nodes=Nodes(
            t_s=mission.times_s.tolist(),
            state=plan.states.tolist(),
            covariance=plan.covariances.tolist(),
            knowledge=plan.known.tolist() if policy is not None else None,
            parameters=plan.parameter_covariances.tolist() if mission.uncertain.count else None,
        ),
        stages=[
            StageSummary(
                name=stage.name,
                status=stage.result.status.value.name,
                total_dv_m_s=float(stage.result.lin.iterate.total_dv * mission.units.speed_m_s),
                iterations=len(stage.result.records),
            )
            for stage in plan.stages
        ],
        facets=_facet_table(mission, plan.final),
        risk=_risk(plan),
        policy=policy,
        starts=plan.starts,
        parent=plan.parent,
        without_uncertainty=plan.without_uncertainty,
        primer=primer_of(plan),
        iterations=[
            iteration_record(mission, stage.name, record)
            for stage in plan.stages
            for record in stage.result.records
        ],
        timing_s=PlanTiming(total=plan.total_s, other=plan.total_s - sum(parts.values()), **parts),
        verification=None,
        warnings=mission.warnings,
        scenario=mission.scenario,
    )
    return _resolved(solution, mission)


def burns_of_plan(plan: Plan) -> list[Burn]:
    """A plan's burns as the file holds them."""
    timed = zip(plan.mission.scenario.burn_times_s, plan.burns_m_s.tolist(), strict=True)
    return [Burn(time, (x, y, z)) for time, (x, y, z) in timed]


def iteration_record(mission: Mission, stage: str, record: Record) -> IterationRecord:
    """One iteration in SI."""
    speed, length = mission.units.speed_m_s, mission.units.length_m
    return IterationRecord(
        stage=stage,
        k=record.k,
        merit=finite(record.merit * speed),
        predicted=finite(record.predicted * speed),
        actual=finite(record.actual * speed),
        accepted=bool(record.accepted),
        trust_radius=float(record.trust_radius * speed),
        max_violation=finite(record.max_violation * length),
        max_defect=finite(record.max_defect * length),
        solver_s=record.solver_s,
    )


def _facet_table(mission: Mission, stage: Stage) -> FacetTable | None:
    facets = stage.facets
    if facets is None:
        return None
    names = [c.name for c in mission.problem.constraints]
    return FacetTable(
        constraint=[names[i] for i in facets.constraint],
        node=facets.node.tolist(),
        normal=[(x, y, z) for x, y, z in facets.normal.tolist()],
        offset_m=(facets.offset * mission.units.length_m).tolist(),
        quantile=facets.quantile.tolist(),
    )


def _risk(plan: Plan) -> Risk | None:
    """Risk of an exact plan: probabilities by the normal law, and the certificate of its flights."""
    if plan.target is None or plan.final.problem == "P3":
        return None
    mission, required = plan.mission, plan.mission.scenario.risk
    margins = plan.final.merit.rows.margins(plan.final.result.lin)
    drifts = {drift.name for drift in mission.problem.drifts}  # flown by the verification
    return Risk(
        scope=required.scope,
        required=required.p_chance,
        target=plan.target,
        certificate=plan.certificate,
        normal_law=[
            EventProbability(
                name=name,
                t_s=mission.times_s[rows.nodes].tolist(),
                probability=ndtr(rows.margin + ndtri(plan.target)).tolist(),
                sigma=(rows.margin + ndtri(plan.target)).tolist(),
            )
            for name, rows in margins.items()
            if plan.final.unit(name) == "sigma" and name not in drifts
        ],
    )


# --- burns that were given and not planned ------------------------------------------------------


def ballistic_arc(mission: Mission) -> Solution:
    """The two-impulse arc between the boundary positions, evaluated as it is, with P3's margins."""
    from scp_recon.planning.initial_guess import (  # SciPy's integrators: readers need none
        ballistic,
        from_burns,
    )

    burns_m_s = ballistic(mission).burns * mission.units.speed_m_s
    lin = mission.dynamics.linearise(mission.problem, from_burns(mission, burns_m_s))
    spec = StageSpec("P3", DeterministicRows(mission.problem), title="ballistic")
    merit = MeritFunction(mission.problem, spec.rows)
    # No iteration was allowed, which is what the status says of a plan that is none.
    result = Result(Status.MAX_ITERATIONS, lin, (), Timing())
    stage = Stage(spec, result, merit, SCvx().feasible)
    provenance = Provenance(NOT_OPTIMISED, NOT_OPTIMISED, NOT_OPTIMISED, "ballistic", "none")
    made = Plan(mission, provenance, 0.0, stages=(stage,), final=stage, timing=Timing())
    solution = make_solution(made)
    message = "Not a plan: the ballistic arc between the boundary positions, evaluated as it is."
    return _resolved(replace(solution, message=message), mission)
