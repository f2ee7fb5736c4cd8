"""Compute a plan's figures from its facts: total delta-v, margins by constraint, violation.

Distances and quantiles come from the regions' centres, radii, apices, axes and angles, in SI. They
share no code with the planner's rows. A file carries the figures for its readers. `disagreements`
names figures that do not follow from the file's facts.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Annotated, Literal, NamedTuple

import numpy as np
from pydantic import ConfigDict, Field
from scipy.special import ndtr, ndtri

from formulations.arrays import Array, Booleans, Indices
from formulations.problem.flyby import Iterate, StateConstraint
from formulations.problem.regions import Ball, Cone
from formulations.rows.cones import FINAL_POSITION, FINAL_VELOCITY
from scp_recon.errors import Named
from scp_recon.mission.grid import Units
from scp_recon.mission.mission import Mission
from scp_recon.physics.flow import propagate
from scp_recon.planning.plan import Unit, scales
from scp_recon.results.corrections import StoredPolicy
from scp_recon.results.facts import FacetTable, Facts, Risk
from scp_recon.scenario.fields import Line, Number
from scp_recon.scp.status import Status

Kind = Literal["keep_in", "keep_out", "burn", "joint", "covariance"]
FINAL_STATE = "final_state"
TIME_ERROR_S = 1e-3
"""Tolerance of times, far above the differences of a window's edges between machines."""
TOLERANCE, FLIGHT_TOLERANCE, STAGE_TOLERANCE = 1e-6, 1e-5, 1e-3
"""Violation that counts as none if a file does not state it: in general, for whole flights, and for
an exact plan that ended in a preliminary stage."""
BARELY = 1.01
"""Times the tolerance that still counts as none: a margin is computed again from rounded numbers."""
MARGIN_ERROR: dict[Unit, float] = {"m": 1e-3, "m/s": 1e-8, "sigma": 1e-9}
"""Error of a carried margin: the variance along a facet is a difference of large numbers."""
SAME_PROBABILITY, ROUNDING = 1e-9, 1e-9
"""Tolerance between a probability and its quantile; relative rounding of sums."""


@dataclass(frozen=True)
class ConstraintResult:
    """The smallest margin of a constraint.

    Attributes:
        name: of the constraint; in an exact plan of a joint constraint, or `whole_flight`.
        kind: limits on the final covariance are of the kind `covariance`.
        worst_margin: >= 0 where satisfied. In P2 the distance to the facet less the quantile times
            the standard deviation, in P3 the mean's distance to the region. Of the kind `joint` the
            probability's quantile less the target's, in standard deviations.
        unit: of the margin.
        worst_t_s: its time.
        facets: number of facets at that node.
    """

    name: Line
    kind: Kind
    worst_margin: float
    unit: Unit
    worst_t_s: float
    facets: int


@dataclass(frozen=True)
class ViolationAmount:
    """Violation of one constraint; `final_state` is the miss of the final state.

    Attributes:
        max: the largest of its buffers.
        total: their sum.
        unit: of both.
    """

    max: Annotated[float, Field(ge=0)]
    total: Annotated[float, Field(ge=0)]
    unit: Unit


@dataclass(frozen=True)
class Violation:
    """Violations above the tolerance; none if the plan is feasible.

    Attributes:
        max: the largest, m; velocities count as metres per unit of time, a standard deviation as a unit
            of length.
        total: their sum.
        by_constraint: violation of each violated constraint.
    """

    max: Annotated[float, Field(ge=0)]
    total: Annotated[float, Field(ge=0)]
    by_constraint: dict[Line, ViolationAmount]


@dataclass(frozen=True, kw_only=True)
class Figures:
    """The figures that a file carries beside its facts, all computed from them.

    Attributes:
        total_dv_m_s: sum of the burns' sizes.
        constraints: the smallest margin of each constraint.
        violation: of all constraints.
        units: of the nondimensional problem.
    """

    __pydantic_config__ = ConfigDict(strict=True, extra="forbid", allow_inf_nan=False)

    total_dv_m_s: Number
    constraints: list[ConstraintResult]
    violation: Violation
    units: Units


class Rows(NamedTuple):
    """Rows of a constraint: their times, s, and margins, >= 0 where satisfied; shape (r,)."""

    kind: Kind
    unit: Unit
    times: Array
    margin: Array


def figures_of(mission: Mission, facts: Facts) -> Figures:
    """Compute all figures from the facts alone; `mission` is that of their scenario."""
    rows = rows_of(mission, facts)
    return Figures(
        total_dv_m_s=total_dv(facts),
        constraints=[_result(name, one, facts) for name, one in rows.items()],
        violation=_violation(mission, facts, rows),
        units=mission.units,
    )


def burns_of(facts: Facts) -> Array:
    """Burns as an array, J2000, m/s, shape (m, 3)."""
    return np.array([burn.dv_m_s for burn in facts.burns]).reshape(-1, 3)


def total_dv(facts: Facts) -> float:
    """Sum of the burns' sizes, m/s."""
    return float(np.linalg.norm(burns_of(facts), axis=1).sum())


def rows_of(mission: Mission, facts: Facts) -> dict[str, Rows]:
    """Rows of every constraint by name: limits on the burns, state constraints, final covariance."""
    times, p2 = np.array(facts.nodes.t_s), facts.problem == "P2"
    rows = {name: Rows("burn", "m/s", *both) for name, both in _burn_rows(mission, facts).items()}
    if p2 and facts.risk is not None:
        target = float(ndtri(facts.risk.target))
        rows |= {
            law.name: Rows("joint", "sigma", np.array(law.t_s), law.quantiles - target)
            for law in facts.risk.normal_law
        }
    else:
        position = np.array(facts.nodes.state)[:, :3]
        facets = facts.facets if p2 else None
        table = None if facets is None else _facet_rows(facts, facets, position)
        for c in mission.problem.constraints:
            if table is None:
                inside = _inside(c, position, mission.units.length_m)
                at, margin = c.nodes, inside if c.keep == "in" else -inside
            else:
                at, margin = table[c.name] if c.name in table else (c.nodes[:0], np.empty(0))
            if len(at):
                kind: Kind = "keep_in" if c.keep == "in" else "keep_out"
                rows[c.name] = Rows(kind, "m", times[at], margin)
    return rows | (final_sigma_rows(mission, facts) if p2 else {})


def _burn_rows(mission: Mission, facts: Facts) -> dict[str, tuple[Array, Array]]:
    """Times and margins of the limits on the burns, m/s; a burn of zero has none."""
    burns, problem = burns_of(facts), mission.problem
    fired = burns.any(axis=1)
    if not fired.any():
        return {}
    times, burns = np.array([burn.t_s for burn in facts.burns])[fired], burns[fired]
    along = np.abs(np.einsum("bi,bi->b", burns, problem.sun[fired]))
    across = np.linalg.norm(np.cross(burns, problem.sun[fired]), axis=1)
    battery = np.cos(problem.dv_cone) * across - np.sin(problem.dv_cone) * along
    size = mission.scenario.burns.dv_max_m_s - np.linalg.norm(burns, axis=1)
    return {"dv_max": (times, size), "dv_battery": (times, battery)}


def _facet_rows(
    facts: Facts, facets: FacetTable, position: Array
) -> dict[str, tuple[Indices, Array]]:
    """Nodes and margins of the facets by constraint: distance less quantile times deviation, m."""
    normal, node = np.array(facets.normal).reshape(-1, 3), np.array(facets.node, dtype=np.intp)
    covariance = np.array(facts.nodes.covariance)[node, :3, :3]
    variance = np.einsum("mi,mij,mj->m", normal, covariance, normal)
    room = np.array(facets.offset_m) - np.einsum("mi,mi->m", normal, position[node])
    room -= np.array(facets.quantile) * np.sqrt(np.maximum(variance, 0.0))
    name = np.array(facets.constraint)
    return {one: (node[name == one], room[name == one]) for one in dict.fromkeys(facets.constraint)}


def _inside(constraint: StateConstraint, position: Array, length: float) -> Array:
    """Distance of the mean to the surface of the region, positive inside, m."""
    region, at = constraint.region, position[constraint.nodes]
    if isinstance(region, Ball):
        return length * region.radius - np.linalg.norm(at - length * region.center, axis=1)
    assert isinstance(region, Cone)  # a mission has no other regions
    off = at - length * region.apex
    along = np.einsum("ni,ni->n", off, region.axis)
    across = np.linalg.norm(np.cross(off, region.axis), axis=1)
    return np.sin(region.half_angle) * along - np.cos(region.half_angle) * across


FINAL_SIGMAS: tuple[tuple[str, slice, Literal["m", "m/s"]], ...] = (
    (FINAL_POSITION, slice(0, 3), "m"),
    (FINAL_VELOCITY, slice(3, 6), "m/s"),
)


def final_sigma_limits(mission: Mission) -> dict[str, float]:
    """A scenario's limits on the covariance after the last burn, m and m/s."""
    boundary = mission.scenario.boundary
    limits = boundary.final_sigma_position_m, boundary.final_sigma_velocity_m_s
    named = zip(FINAL_SIGMAS, limits, strict=True)
    return {name: limit for (name, _, _), limit in named if limit is not None}


def final_sigma_rows(mission: Mission, facts: Facts) -> dict[str, Rows]:
    """Margins of these limits: limit less root of the summed variances at the last node."""
    variances, limits = np.diag(np.array(facts.nodes.covariance[-1])), final_sigma_limits(mission)
    end = np.array(facts.nodes.t_s[-1:])
    return {
        name: Rows(
            "covariance",
            unit,
            end,
            np.array([limits[name] - np.sqrt(max(float(variances[part].sum()), 0.0))]),
        )
        for name, part, unit in FINAL_SIGMAS
        if name in limits
    }


def _result(name: str, rows: Rows, facts: Facts) -> ConstraintResult:
    """The smallest margin, and the number of facets at its node."""
    worst = int(np.argmin(rows.margin))
    return ConstraintResult(
        name=name,
        kind=rows.kind,
        worst_margin=finite(rows.margin[worst]),
        unit=rows.unit,
        worst_t_s=float(rows.times[worst]),
        facets=_facets_at(rows, rows.times == rows.times[worst], facts),
    )


def _facets_at(rows: Rows, there: Booleans, facts: Facts) -> int:
    of_facets = facts.facets is not None and facts.problem == "P2" and rows.kind != "burn"
    return int(there.sum()) if of_facets and rows.kind != "covariance" else 0


def tolerance_of(facts: Facts) -> float:
    """Violation that counts as none, in units of the nondimensional problem."""
    if facts.tolerance is not None:
        return facts.tolerance
    flights = facts.risk is not None and facts.risk.scope == "flight"
    return FLIGHT_TOLERANCE if flights else TOLERANCE


def _violation(mission: Mission, facts: Facts, rows: dict[str, Rows]) -> Violation:
    """Amounts above the tolerance at which a constraint counts as satisfied."""
    scale, least = scales(mission.units), BARELY * tolerance_of(facts)
    parts = {}
    for name, (unit, amount) in _amounts(mission, facts, rows).items():
        used = amount[amount > least * scale[unit]]
        if len(used):
            parts[name] = ViolationAmount(finite(used.max()), finite(used.sum()), unit)
    return _summed(parts, mission.units)


def _amounts(
    mission: Mission, facts: Facts, rows: dict[str, Rows]
) -> dict[str, tuple[Unit, Array]]:
    """Signed violations by constraint, negative where there is slack, and of the final state.

    Defects between nodes count as a miss of the final state.
    """
    states, units = np.array(facts.nodes.state), mission.units
    with np.errstate(all="ignore"):
        begin, took = np.array(facts.nodes.t_s[:-1]), np.diff(facts.nodes.t_s)
        arcs = propagate(states[:-1], took, mission.forces, mission.arc_substeps, begin)
        flown = Iterate(burns_of(facts) / units.speed_m_s, states / units.state)
        defects = np.abs(mission.problem.defects(flown, arcs / units.state)) * units.length_m
    if not mission.must_meet:
        defects = defects[:-1]
    amounts: dict[str, tuple[Unit, Array]] = {FINAL_STATE: ("m", defects.ravel())}
    return amounts | {name: (one.unit, -one.margin) for name, one in rows.items()}


def _summed(parts: dict[str, ViolationAmount], units: Units) -> Violation:
    """The sum in metres: velocities over a unit of time, sigmas as units of length."""
    scale = scales(units)
    metres = {name: units.length_m / scale[part.unit] for name, part in parts.items()}
    most = max((part.max * metres[name] for name, part in parts.items()), default=0.0)
    total = sum(part.total * metres[name] for name, part in parts.items())
    return Violation(finite(most), finite(total), Named(parts))


def finite(value: float) -> float:
    """A figure with infinity replaced by the largest number: JSON has no infinity."""
    return float(np.nan_to_num(value, nan=np.finfo(float).max))


def strange_times(
    mission: Mission, burn_times_s: Sequence[float], node_times_s: Sequence[float]
) -> list[str]:
    """Names of a plan's times, `burns.t_s` or `nodes.t_s`, that are not its mission's.

    The window's edges are found by a root search, so that nodes agree within `TIME_ERROR_S`. Burns,
    and the nodes they fall on, are at the scenario's own numbers, to the last bit.
    """
    firing, nodes = np.array(mission.scenario.burn_times_s), np.array(node_times_s)
    agree = {
        "burns.t_s": np.array_equal(burn_times_s, firing),
        "nodes.t_s": len(nodes) == len(mission.times_s)
        and np.allclose(nodes, mission.times_s, rtol=0.0, atol=TIME_ERROR_S)
        and np.array_equal(nodes[mission.burn_nodes], firing),
    }
    return [name for name, does in agree.items() if not does]


def is_strange(mission: Mission, policy: StoredPolicy | None) -> bool:
    """Whether corrected burns and their cut-offs are not those of a mission; none never are."""
    if policy is None:
        return False
    feedback, flown = mission.feedback, mission.scenario.burns_flown
    if feedback is None:
        return True
    burns = [correction.burn - 1 - flown for correction in policy.corrections]
    cut_offs = [correction.cut_off_s for correction in policy.corrections]
    return burns != feedback.burns.tolist() or not np.allclose(
        cut_offs, mission.times_s[feedback.cut_offs], rtol=0.0, atol=TIME_ERROR_S
    )


def disagreements(mission: Mission, facts: Facts, carried: Figures) -> list[str]:
    """Names of a file's figures that do not follow from its facts, within rounding.

    The status must be that of a stage, unless the plan was interrupted. A converged plan must
    violate nothing. The required risk must be the scenario's.
    """
    rows, found = rows_of(mission, facts), []
    stages = {stage.status for stage in facts.stages}
    if stages and facts.status not in stages | {Status.INTERRUPTED.value.name}:
        found.append("status")
    if not np.isclose(total_dv(facts), carried.total_dv_m_s, rtol=ROUNDING, atol=1e-12):
        found.append("total_dv_m_s")
    if facts.risk is not None and not _is_of_scenario(facts.risk, mission):
        found.append("risk")
    stored = {c.name: c for c in carried.constraints}
    if (
        len(stored) != len(carried.constraints)
        or stored.keys() != rows.keys()
        or not all(_is_result(stored[name], one, facts) for name, one in rows.items())
    ):
        found.append("constraints")
    amounts, error = _amounts(mission, facts, rows), _amount_errors(mission.units, facts)
    if not (
        _adds_up(carried.violation, mission.units)
        and carried.violation.by_constraint.keys() <= amounts.keys()
        and all(
            _is_amount(carried.violation.by_constraint.get(name), unit, amount, error[unit])
            for name, (unit, amount) in amounts.items()
        )
    ) or (is_converged(facts) and carried.violation.by_constraint):
        found.append("violation")
    return found


def is_converged(facts: Facts) -> bool:
    """Whether a plan's status is converged."""
    return facts.status == Status.CONVERGED.value.name


def _is_of_scenario(risk: Risk, mission: Mission) -> bool:
    """Whether scope and probability are those required, and the quantiles those of the law."""
    required, laws = mission.scenario.risk, risk.normal_law
    return (risk.scope, risk.required) == (required.scope, required.p_chance) and all(
        np.abs(ndtr(law.quantiles) - law.probability).max() <= SAME_PROBABILITY for law in laws
    )


def _is_result(reported: ConstraintResult, rows: Rows, facts: Facts) -> bool:
    """Whether kind, unit and facets agree, and the margin is the smallest, at its time."""
    there = np.abs(rows.times - reported.worst_t_s) <= TIME_ERROR_S
    least = np.array([rows.margin.min(), rows.margin[there].min(initial=np.inf)])
    if (reported.kind, reported.unit) != (rows.kind, rows.unit):
        return False
    if reported.facets != _facets_at(rows, there, facts):
        return False
    return bool(np.abs(reported.worst_margin - least).max() <= MARGIN_ERROR[reported.unit])


def _amount_errors(units: Units, facts: Facts) -> dict[Unit, float]:
    """Allowed errors of an amount by unit: the tolerance, and the rounding of margins."""
    stage = facts.tolerance is None and facts.risk is not None
    none = max(TOLERANCE, STAGE_TOLERANCE if stage else tolerance_of(facts))
    return {
        unit: BARELY * none * scale + MARGIN_ERROR[unit] for unit, scale in scales(units).items()
    }


def _is_amount(reported: ViolationAmount | None, unit: Unit, amount: Array, error: float) -> bool:
    """Whether a carried amount agrees with the rows within an error."""
    used = np.maximum(amount, 0.0)
    if reported is None:
        return bool(used.max(initial=0.0) <= error)
    close = reported.unit == unit and abs(used.max() - reported.max) <= error
    return bool(close and reported.total <= used.sum() + amount.size * error)


def _adds_up(violation: Violation, units: Units) -> bool:
    """Whether the maximum and the sum are those of the constraints, and zero if there are none."""
    parts = violation.by_constraint
    if not all(part.total >= part.max * (1.0 - ROUNDING) > 0.0 for part in parts.values()):
        return False
    summed = _summed(parts, units)
    carried = [violation.max, violation.total]
    return np.allclose(carried, [summed.max, summed.total], rtol=ROUNDING, atol=0.0)
