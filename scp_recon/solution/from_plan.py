"""From a plan to a solution: back to SI, margins by constraint, what the buffers hold."""

from __future__ import annotations

from dataclasses import asdict
from typing import Literal

import numpy as np
from scipy.special import ndtr, ndtri

from formulations.rows.final_spread import FINAL_POSITION, FINAL_VELOCITY
from scp_recon.mission.mission import Mission
from scp_recon.planning.plan import Plan
from scp_recon.planning.primer import primer_of
from scp_recon.planning.provenance import Starts
from scp_recon.planning.stage import BURN_LIMITS, Stage, scale
from scp_recon.scp.loop import Record
from scp_recon.solution.file import (
    Burn,
    ConstraintResult,
    FacetTable,
    IterationRecord,
    LocalOptimum,
    Nodes,
    Solution,
    StageSummary,
    StartsSummary,
    TimingSummary,
    UnitScales,
    Violation,
    ViolationAmount,
)
from scp_recon.solution.parent import ParentPlan
from scp_recon.solution.primer import Primer
from scp_recon.solution.risk import EventProbability, Reached, Risk

FINAL_STATE = "final_state"
FINAL_SIGMAS = (FINAL_POSITION, FINAL_VELOCITY)


def make_solution(plan: Plan) -> Solution:
    """Collect a plan into the solution file's form, not yet verified."""
    mission, made = plan.mission, plan.provenance
    outcome = plan.final.result.status.value
    return Solution(
        status=outcome.name,
        message=f"{outcome.message} {outcome.remedy}".strip(),
        problem=plan.final.problem,
        init=made.init,
        method=made.method,
        formulation=made.formulation,
        algorithm=made.algorithm,
        solver=made.solver,
        total_dv_m_s=plan.total_dv_m_s,
        burns=burns_of(plan),
        nodes=Nodes(
            t_s=mission.times_s.tolist(),
            state=plan.states.tolist(),
            covariance=plan.covariances.tolist(),
        ),
        stages=[_summary(mission, stage) for stage in plan.stages],
        constraints=constraint_results(mission, plan.final),
        facets=_facet_table(mission, plan.final),
        risk=_risk(plan),
        starts=_starts(plan.starts),
        parent=None if plan.parent is None else ParentPlan(**asdict(plan.parent)),
        primer=_primer(plan),
        violation=_violation(mission, plan.final),
        iterations=[
            iteration_record(mission, stage.name, record)
            for stage in plan.stages
            for record in stage.result.records
        ],
        timing_s=_timing(plan),
        units=UnitScales(length_m=mission.units.length_m, time_s=mission.units.time_s),
        verification=None,
        warnings=mission.warnings,
        scenario=mission.scenario,
    )


def burns_of(plan: Plan) -> list[Burn]:
    """Its burns as the file has them."""
    timed = zip(plan.mission.scenario.burn_times_s, plan.burns_m_s, strict=True)
    return [Burn(t_s=time, dv_m_s=tuple(burn.tolist())) for time, burn in timed]


def iteration_record(mission: Mission, stage: str, record: Record) -> IterationRecord:
    """One iteration in SI."""
    speed, length = mission.units.speed_m_s, mission.units.length_m
    return IterationRecord(
        stage=stage,
        k=record.k,
        merit=_finite(record.merit * speed),
        predicted=_finite(record.predicted * speed),
        actual=_finite(record.actual * speed),
        accepted=record.accepted,
        trust_radius=record.trust_radius * speed,
        max_violation=_finite(record.max_violation * length),
        max_defect=_finite(record.max_defect * length),
        solver_s=record.solver_s,
    )


def _finite(value: float) -> float:
    """A diverged figure as the largest number there is: JSON knows no infinity."""
    return float(np.nan_to_num(value, nan=np.finfo(float).max))


def constraint_results(mission: Mission, stage: Stage) -> list[ConstraintResult]:
    """Worst margin of every constraint, those left out of the convex program included."""
    kinds: dict[str, Literal["keep_in", "keep_out", "burn", "covariance"]] = {
        c.name: "keep_in" if c.keep == "in" else "keep_out" for c in mission.problem.constraints
    }
    kinds |= dict.fromkeys(BURN_LIMITS, "burn")
    kinds |= dict.fromkeys(FINAL_SIGMAS, "covariance")
    regions = {c.name for c in mission.problem.constraints}
    results = []
    for name, margins in stage.margins.items():
        unit = stage.unit(name)
        worst = int(np.argmin(margins.margin))
        at_worst = int((margins.nodes == margins.nodes[worst]).sum())
        results.append(
            ConstraintResult(
                name=name,
                kind="joint" if unit == "sigma" else kinds[name],
                worst_margin=float(margins.margin[worst]) * scale(mission, unit),
                unit=unit,
                worst_t_s=float(mission.times_s[margins.nodes[worst]]),
                facets=at_worst if stage.facets is not None and name in regions else 0,
            )
        )
    return results


def _facet_table(mission: Mission, stage: Stage) -> FacetTable | None:
    facets = stage.facets
    if facets is None:
        return None
    names = [c.name for c in mission.problem.constraints]
    return FacetTable(
        constraint=[names[i] for i in facets.constraint],
        node=facets.node.tolist(),
        normal=facets.normal.tolist(),
        offset_m=(facets.offset * mission.units.length_m).tolist(),
        quantile=facets.quantile.tolist(),
    )


def _starts(starts: Starts | None) -> StartsSummary | None:
    if starts is None:
        return None
    optima = [
        LocalOptimum(
            problem=optimum.problem,
            status=optimum.status,
            total_dv_m_s=optimum.total_dv_m_s,
            burns_m_s=list(optimum.burns_m_s),
            starts=list(optimum.starts),
        )
        for optimum in starts.optima
    ]
    return StartsSummary(number=starts.number, seed=starts.seed, optima=optima)


def _risk(plan: Plan) -> Risk | None:
    """What an exact plan spends: probabilities by the normal law, and what flights reached."""
    if plan.aim is None or plan.final.problem == "P3":
        return None
    mission, asked = plan.mission, plan.mission.scenario.risk
    margins = plan.final.merit.rows.margins(plan.final.result.lin)
    return Risk(
        scope=asked.scope,
        asked=asked.p_chance,
        aim=plan.aim,
        certificate=None if plan.certificate is None else Reached(**asdict(plan.certificate)),
        normal_law=[
            EventProbability(
                name=name,
                t_s=mission.times_s[rows.nodes].tolist(),
                probability=ndtr(rows.margin + ndtri(plan.aim)).tolist(),
            )
            for name, rows in margins.items()
            if name not in FINAL_SIGMAS
        ],
    )


def _primer(plan: Plan) -> Primer | None:
    history = primer_of(plan)
    if history is None:
        return None
    return Primer(
        t_s=history.times_s.tolist(),
        vector=[(x, y, z) for x, y, z in history.vector.tolist()],
        allowed=history.allowed.tolist(),
        legal=history.legal.tolist(),
        residual=history.residual,
    )


def _violation(mission: Mission, stage: Stage) -> Violation:
    """Amounts above the tolerance at which a constraint counts as satisfied."""
    length = mission.units.length_m
    by_constraint = {}
    scaled = [np.zeros(1)]
    for name, amounts in stage.merit.violations(stage.result.lin).items():
        used = amounts[amounts > stage.tolerance]
        if len(used):
            scaled.append(used)
            unit = stage.unit(name)
            si = used * scale(mission, unit)
            label = FINAL_STATE if name == "dynamics" else name
            by_constraint[label] = ViolationAmount(max=si.max(), total=si.sum(), unit=unit)
    everything = np.concatenate(scaled) * length
    return Violation(max=everything.max(), total=everything.sum(), by_constraint=by_constraint)


def _summary(mission: Mission, stage: Stage) -> StageSummary:
    return StageSummary(
        name=stage.name,
        status=stage.result.status.value.name,
        total_dv_m_s=stage.result.lin.iterate.total_dv * mission.units.speed_m_s,
        iterations=len(stage.result.records),
    )


def _timing(plan: Plan) -> TimingSummary:
    parts = vars(plan.timing)
    return TimingSummary(total=plan.total_s, other=plan.total_s - sum(parts.values()), **parts)
