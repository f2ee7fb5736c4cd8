"""Whether what a solution says of its constraints follows from its own burns, nodes and facets.

Distances and quantiles are worked out here from the regions' centres, radii, apices, axes and angles,
in SI, and share no code with the planner's rows. What is not checked is that a polytope's facets
together lie within a keep-in region; the Monte Carlo estimate stands behind that.
"""

from __future__ import annotations

from typing import Literal

import numpy as np
import numpy.typing as npt
from scipy.special import ndtr

from formulations.problem.flyby import StateConstraint
from formulations.problem.regions import Ball
from scp_recon.mission.mission import Mission
from scp_recon.scp.status import Status
from scp_recon.solution.file import FacetTable, Solution, Violation, ViolationAmount
from scp_recon.solution.times import TIME_ERROR_S, strange_times
from scp_recon.verification.exact import exact_inconsistencies
from scp_recon.verification.final_sigmas import final_margins

Array = npt.NDArray[np.float64]

MARGIN_ERROR = {"m": 1e-3, "m/s": 1e-8}
"""Of a stored margin: the variance along a facet is a difference of large numbers."""
TOLERANCE = 1e-6
"""In units of length or speed, below which a buffer holds nothing; see `docs/solution_file.md`."""
FACET_ERROR = 1e-9
ROUNDING = 1e-9
"""Relative, of sums and of a change of units."""
FINAL_STATE = "final_state"


def inconsistencies(mission: Mission, solution: Solution) -> list[str]:
    """Parts of a solution that contradict its scenario or each other."""
    found = strange_times(mission, [b.t_s for b in solution.burns], solution.nodes.t_s)
    total = np.linalg.norm(solution.burns_m_s, axis=1).sum()
    if not np.isclose(total, solution.total_dv_m_s, atol=1e-12):
        found.append("total_dv_m_s")
    if "nodes.t_s" in found:  # nothing else can be told without them
        return found
    if solution.problem == "P2" and mission.scenario.risk.allocation == "exact":
        own = burn_margins(mission, solution)
        return found + exact_inconsistencies(mission, solution, own)
    if solution.problem == "P2" and not _are_sound(mission, solution.facets):
        return [*found, "facets"]
    margins = _margins(mission, solution)
    if not _are_results(mission, solution, margins):
        found.append("constraints")
    converged = solution.status == Status.CONVERGED.value.name
    if (
        (converged and solution.violation.by_constraint)
        or not _is_violation(mission, solution, margins)
        or not _adds_up(mission, solution.violation)
    ):
        found.append("violation")
    return found


def _unit(name: str) -> Literal["m", "m/s"]:
    return "m/s" if name.startswith("dv_") or name == "final_velocity_sigma" else "m"


def burn_margins(mission: Mission, solution: Solution) -> dict[str, Array]:
    """Margins of the limits on the burns, >= 0 where satisfied, m/s."""
    burns, problem = solution.burns_m_s, mission.problem
    size = np.linalg.norm(burns, axis=1)
    along = np.abs(np.einsum("bi,bi->b", burns, problem.sun))
    across = np.linalg.norm(np.cross(burns, problem.sun), axis=1)
    return {
        "dv_max": mission.scenario.burns.dv_max_m_s - size,
        "dv_battery": np.cos(problem.dv_cone) * across - np.sin(problem.dv_cone) * along,
    }


def _margins(mission: Mission, solution: Solution) -> dict[str, Array]:
    """Margins of every constraint's rows, >= 0 where satisfied; m, and m/s of the burns."""
    problem, margins = mission.problem, burn_margins(mission, solution)
    position = np.array(solution.nodes.state)[:, :3]
    if solution.problem == "P3" or solution.facets is None:
        inside = {c.name: _inside(c, position, mission.units.length_m) for c in problem.constraints}
        return margins | {
            c.name: inside[c.name] if c.keep == "in" else -inside[c.name]
            for c in problem.constraints
        }
    facets = solution.facets
    normal, node = np.array(facets.normal), np.array(facets.node, dtype=np.intp)
    covariance = np.array(solution.nodes.covariance)[node, :3, :3]
    variance = np.einsum("mi,mij,mj->m", normal, covariance, normal)
    room = np.array(facets.offset_m) - np.einsum("mi,mi->m", normal, position[node])
    room -= np.array(facets.quantile) * np.sqrt(np.maximum(variance, 0.0))
    name = np.array(facets.constraint)
    own = {c.name: room[name == c.name] for c in problem.constraints}
    return margins | own | final_margins(mission, solution)


def _nodes(mission: Mission, solution: Solution) -> dict[str, npt.NDArray[np.intp]]:
    """Node of every row of `_margins`."""
    problem, facets = mission.problem, solution.facets
    nodes = dict.fromkeys(("dv_max", "dv_battery"), problem.burn_nodes)
    last = np.array([problem.n_nodes - 1])
    if solution.problem == "P3" or facets is None:
        return nodes | {c.name: c.nodes for c in problem.constraints}
    name, node = np.array(facets.constraint), np.array(facets.node, dtype=np.intp)
    own = {c.name: node[name == c.name] for c in problem.constraints}
    return nodes | own | dict.fromkeys(final_margins(mission, solution), last)


def _are_results(mission: Mission, solution: Solution, margins: dict[str, Array]) -> bool:
    """Whether each constraint is listed once, with its kind and the place of its smallest margin."""
    stored, nodes = {c.name: c for c in solution.constraints}, _nodes(mission, solution)
    if len(stored) != len(solution.constraints) or stored.keys() != margins.keys():
        return False
    kinds = {c.name: f"keep_{c.keep}" for c in mission.problem.constraints}
    regions = set(kinds)
    kinds = kinds | dict.fromkeys(final_margins(mission, solution), "covariance")
    for name, margin in margins.items():
        told, unit = stored[name], _unit(name)
        there = np.abs(mission.times_s[nodes[name]] - told.worst_t_s) <= TIME_ERROR_S
        facets = there.sum() if solution.problem == "P2" and name in regions else 0
        least = np.array([margin.min(), margin[there].min(initial=np.inf)])
        if np.abs(told.worst_margin - least).max() > MARGIN_ERROR[unit]:
            return False
        if (told.kind, told.unit, told.facets) != (kinds.get(name, "burn"), unit, facets):
            return False
    return True


def _inside(constraint: StateConstraint, position: Array, length: float) -> Array:
    """Distance of the mean to the surface of the region, positive inside, m."""
    region, at = constraint.region, position[constraint.nodes]
    if isinstance(region, Ball):
        return length * region.radius - np.linalg.norm(at - length * region.center, axis=1)
    off = at - length * region.apex
    along = np.einsum("ni,ni->n", off, region.axis)
    across = np.linalg.norm(np.cross(off, region.axis), axis=1)
    return np.sin(region.half_angle) * along - np.cos(region.half_angle) * across


def _are_sound(mission: Mission, facets: FacetTable | None) -> bool:
    """Whether the facets leave no more risk than was asked, and keep-out planes touch no region."""
    if facets is None:
        return False
    normal, offset = np.array(facets.normal).reshape(-1, 3), np.array(facets.offset_m)
    if not np.allclose(np.linalg.norm(normal, axis=1), 1.0, atol=FACET_ERROR):
        return False
    name, node = np.array(facets.constraint), np.array(facets.node, dtype=np.intp)
    risk = ndtr(-np.array(facets.quantile))
    for c in mission.problem.constraints:
        rows = np.flatnonzero(name == c.name)
        if not np.array_equal(np.unique(node[rows]), c.nodes):
            return False
        taken = np.bincount(node[rows], risk[rows], mission.problem.n_nodes)
        if np.any(taken[c.nodes] > 1.0 - c.probability + FACET_ERROR):
            return False
        if c.keep == "out":
            at = np.searchsorted(c.nodes, node[rows])
            beyond = _least(c, at, normal[rows], mission.units.length_m) - offset[rows]
            if np.any(beyond < -FACET_ERROR * mission.units.length_m):
                return False
    return len(name) == np.isin(name, [c.name for c in mission.problem.constraints]).sum()


def _least(constraint: StateConstraint, at: npt.NDArray[np.intp], normal: Array, m: float) -> Array:
    """Smallest n'y over each region, m; -inf where a cone reaches through the plane."""
    region = constraint.region
    if isinstance(region, Ball):
        return m * (np.einsum("ri,ri->r", normal, region.center[at]) - region.radius)
    leans = (
        np.einsum("ri,ri->r", normal, region.axis[at]) >= np.sin(region.half_angle) - FACET_ERROR
    )
    return np.where(leans, m * np.einsum("ri,ri->r", normal, region.apex[at]), -np.inf)


def _is_violation(mission: Mission, solution: Solution, margins: dict[str, Array]) -> bool:
    """Whether the stored violation is what the margins and the final state leave."""
    miss = np.array(solution.nodes.state[-1]) - mission.final_state
    scaled = np.abs(miss) / mission.units.state * mission.units.length_m
    amounts = {name: -margin for name, margin in margins.items()}
    if mission.must_meet:
        amounts[FINAL_STATE] = scaled
    scale = {"m": mission.units.length_m, "m/s": mission.units.speed_m_s}
    stored = solution.violation.by_constraint
    for name, amount in amounts.items():
        unit = _unit(name)
        told = stored.get(name, ViolationAmount(max=0.0, total=0.0, unit=unit))
        error = TOLERANCE * scale[unit] + MARGIN_ERROR[unit]
        used = np.maximum(amount, 0.0)
        if told.unit != unit or abs(used.max() - told.max) > error:
            return False
        if told.total > used.sum() + amount.size * error:
            return False
    return stored.keys() <= amounts.keys()


def _adds_up(mission: Mission, violation: Violation) -> bool:
    """Whether the maximum and the sum are those of the constraints, and zero if there are none."""
    parts = violation.by_constraint.values()
    if not all(part.total >= part.max * (1.0 - ROUNDING) > 0.0 for part in parts):
        return False
    metres = {"m": 1.0, "m/s": mission.units.time_s}
    most = max((part.max * metres[part.unit] for part in parts), default=0.0)
    total = sum(part.total * metres[part.unit] for part in parts)
    told = [violation.max, violation.total]
    return np.allclose(told, [most, total], rtol=ROUNDING, atol=0.0)
