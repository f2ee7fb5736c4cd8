"""Compute a plan's figures from its facts: total delta-v, margins by constraint, violation.

Distances and quantiles come from the regions' centres, radii, apices, axes and angles, in SI. They
share no code with the planner's rows. A file carries the figures for its readers; `verify` compares
them with the computed ones.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Literal, NamedTuple

import numpy as np
from pydantic import ConfigDict, Field
from scipy.special import ndtri

from formulations.arrays import Array, Booleans, Indices
from formulations.problem.flyby import Iterate, StateConstraint
from formulations.problem.regions import Ball, Cone, Motion
from formulations.rows.cones import FINAL_POSITION, FINAL_VELOCITY
from scp_recon.errors import Named
from scp_recon.mission.mission import Mission
from scp_recon.mission.scene import Units
from scp_recon.physics.flow import propagate
from scp_recon.planning.plan import Unit, scales
from scp_recon.results.facts import FacetTable, Facts
from scp_recon.results.policy import StoredPolicy
from scp_recon.scenario.fields import Line, Number
from scp_recon.scp.status import Status

Kind = Literal["keep_in", "keep_out", "burn", "joint", "covariance"]
FINAL_STATE = "final_state"
TIME_ERROR_S = 1e-3
"""Tolerance of times, far above the differences of a window's edges between machines."""
BARELY = 1.01
"""Times the tolerance that still counts as none: a margin is computed again from rounded numbers."""


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
        total_dv_m_s=facts.total_dv_m_s,
        constraints=[_result(name, one, facts) for name, one in rows.items()],
        violation=_violation(mission, facts, rows),
        units=mission.units,
    )


def rows_of(mission: Mission, facts: Facts) -> dict[str, Rows]:
    """Rows of every constraint by name: limits on the burns, state constraints, final covariance."""
    times, p2 = np.array(facts.nodes.t_s), facts.problem == "P2"
    rows = {name: Rows("burn", "m/s", *both) for name, both in _burn_rows(mission, facts).items()}
    if p2 and facts.risk is not None:
        target = float(ndtri(facts.risk.target))
        rows |= {
            law.name: Rows("joint", "sigma", np.array(law.t_s), np.array(law.sigma) - target)
            for law in facts.risk.normal_law
        }
    else:
        position = np.array(facts.nodes.state)[:, :3]
        facets = facts.facets if p2 else None
        table = None if facets is None else _facet_rows(mission, facts, facets, position)
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
    burns, problem = facts.burns_m_s, mission.problem
    fired = burns.any(axis=1)
    if not fired.any():
        return {}
    times, burns = np.array([burn.t_s for burn in facts.burns])[fired], burns[fired]
    along = np.abs(np.einsum("bi,bi->b", burns, problem.sun[fired]))
    across = np.linalg.norm(np.cross(burns, problem.sun[fired]), axis=1)
    battery = np.cos(problem.dv_cone) * across - np.sin(problem.dv_cone) * along
    size = mission.scenario.burns.dv_max_m_s - np.linalg.norm(burns, axis=1)
    return {"dv_max": (times, size), "dv_battery": (times, battery)}


def relative_covariances(mission: Mission, facts: Facts, motion: Motion, nodes: Indices) -> Array:
    """Covariances of positions at nodes relative to a region that moves there, m^2, shape (n, 3, 3)."""
    length, position = mission.units.length_m, np.array(facts.nodes.state)[nodes, :3]
    own = np.array(facts.nodes.covariance)[nodes, :3, :3]
    cross = np.array(facts.nodes.parameters)[nodes, :3]
    seen = length * motion.seen(position / length)
    both = cross @ seen.swapaxes(1, 2)
    return np.asarray(own + both + both.swapaxes(1, 2) + seen @ seen.swapaxes(1, 2))


def _facet_rows(
    mission: Mission, facts: Facts, facets: FacetTable, position: Array
) -> dict[str, tuple[Indices, Array]]:
    """Nodes and margins of the facets by constraint: distance less quantile times deviation, m."""
    normal, node = np.array(facets.normal).reshape(-1, 3), np.array(facets.node, dtype=np.intp)
    covariance = np.array(facts.nodes.covariance)[node, :3, :3]
    for c in mission.problem.constraints if facts.nodes.parameters is not None else ():
        own = np.flatnonzero((np.array(facets.constraint) == c.name) & np.isin(node, c.nodes))
        if c.motion is not None:
            motion = c.motion.at(np.searchsorted(c.nodes, node[own]))
            covariance[own] = relative_covariances(mission, facts, motion, node[own])
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
    end, found = np.array(facts.nodes.t_s[-1:]), {}
    for name, part, unit in FINAL_SIGMAS:
        if name in limits:
            sigma = np.sqrt(max(float(variances[part].sum()), 0.0))
            found[name] = Rows("covariance", unit, end, np.array([limits[name] - sigma]))
    return found


def _result(name: str, rows: Rows, facts: Facts) -> ConstraintResult:
    """The smallest margin, and the number of facets at its node."""
    worst = int(np.argmin(rows.margin))
    return ConstraintResult(
        name=name,
        kind=rows.kind,
        worst_margin=finite(rows.margin[worst]),
        unit=rows.unit,
        worst_t_s=float(rows.times[worst]),
        facets=facets_at(rows, rows.times == rows.times[worst], facts),
    )


def facets_at(rows: Rows, there: Booleans, facts: Facts) -> int:
    """Number of facets at the nodes of a constraint that are selected; 0 where it has none."""
    of_facets = facts.facets is not None and facts.problem == "P2" and rows.kind != "burn"
    return int(there.sum()) if of_facets and rows.kind != "covariance" else 0


def _violation(mission: Mission, facts: Facts, rows: dict[str, Rows]) -> Violation:
    """Amounts above the tolerance at which a constraint counts as satisfied."""
    scale, least = scales(mission.units), BARELY * facts.tolerance
    parts = {}
    for name, (unit, amount) in amounts_of(mission, facts, rows).items():
        used = amount[amount > least * scale[unit]]
        if len(used):
            parts[name] = ViolationAmount(finite(used.max()), finite(used.sum()), unit)
    return summed(parts, mission.units)


def amounts_of(
    mission: Mission, facts: Facts, rows: dict[str, Rows]
) -> dict[str, tuple[Unit, Array]]:
    """Signed violations by constraint, negative where there is slack, and of the final state.

    Defects between nodes count as a miss of the final state.
    """
    states, units = np.array(facts.nodes.state), mission.units
    with np.errstate(all="ignore"):
        begin, took = np.array(facts.nodes.t_s[:-1]), np.diff(facts.nodes.t_s)
        arcs = propagate(states[:-1], took, mission.forces, mission.arc_substeps, begin)
        flown = Iterate(facts.burns_m_s / units.speed_m_s, states / units.state)
        defects = np.abs(mission.problem.defects(flown, arcs / units.state)) * units.length_m
    if not mission.must_meet:
        defects = defects[:-1]
    amounts: dict[str, tuple[Unit, Array]] = {FINAL_STATE: ("m", defects.ravel())}
    return amounts | {name: (one.unit, -one.margin) for name, one in rows.items()}


def summed(parts: dict[str, ViolationAmount], units: Units) -> Violation:
    """The sum in metres: velocities over a unit of time, sigmas as units of length."""
    scale = scales(units)
    metres = {name: units.length_m / scale[part.unit] for name, part in parts.items()}
    most = max((part.max * metres[name] for name, part in parts.items()), default=0.0)
    total = sum(part.total * metres[name] for name, part in parts.items())
    return Violation(finite(most), finite(total), Named(parts))


def finite(value: float) -> float:
    """A figure with infinity replaced by the largest number: JSON has no infinity."""
    return float(np.nan_to_num(value, nan=np.finfo(float).max))


def strange_parts(mission: Mission, facts: Facts) -> list[str]:
    """Names of a plan's times and corrections that are not its mission's.

    The window's edges are found by a root search, so that nodes and cut-offs agree within
    `TIME_ERROR_S`. Burns, and the nodes they fall on, are at the scenario's own numbers, to the last
    bit.
    """
    firing, nodes = np.array(mission.scenario.burn_times_s), np.array(facts.nodes.t_s)
    agree = {
        "burns.t_s": np.array_equal([burn.t_s for burn in facts.burns], firing),
        "nodes.t_s": len(nodes) == len(mission.times_s)
        and np.allclose(nodes, mission.times_s, rtol=0.0, atol=TIME_ERROR_S)
        and np.array_equal(nodes[mission.burn_nodes], firing),
        "policy.corrections": facts.policy is None or _is_of(mission, facts.policy),
    }
    return [name for name, does in agree.items() if not does]


def _is_of(mission: Mission, policy: StoredPolicy) -> bool:
    """Whether corrected burns, cut-offs and what is estimated are a mission's."""
    feedback, first = mission.feedback, 1 + mission.scenario.burns_flown
    return (
        feedback is not None
        and [c.burn - first for c in policy.corrections] == feedback.burns.tolist()
        and {len(c.estimate_covariance) for c in policy.corrections} == {6 + mission.estimated}
        and np.allclose(
            [c.cut_off_s for c in policy.corrections],
            mission.times_s[feedback.cut_offs],
            rtol=0.0,
            atol=TIME_ERROR_S,
        )
    )


def is_converged(facts: Facts) -> bool:
    """Whether a plan's status is converged."""
    return facts.status == Status.CONVERGED.value.name
