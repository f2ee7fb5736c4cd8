"""Rows of the NLPs: limits on the burns, P3's sets, P2's facets; margins, >= 0 where satisfied."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import casadi as ca
import numpy as np

from formulations.nlp.covariance import Spread, root
from formulations.nlp.program import NlpRows
from formulations.problem.facets import Facets
from formulations.problem.flyby import FlybyProblem, StateConstraint
from formulations.problem.regions import Array, Ball


def total_dv(burns: ca.MX) -> ca.MX:
    """Sum of the sizes of burns (3, m)."""
    return ca.sum2(_norm(burns))


def burn_blocks(problem: FlybyProblem, burns: ca.MX, *, printed: bool) -> list[NlpRows]:
    """Size and battery cone of burns (3, m).

    Args:
        problem: the limits.
        burns: the unknowns.
        printed: angles by the ratios that the paper prints, not as `FlybyProblem.burn_margins`.
    """
    nappes = [-_inside_cone(burns, sun, problem.dv_cone, printed) for sun in _nappes(problem)]
    return [
        NlpRows("dv_max", (problem.dv_max - _norm(burns)).T),
        NlpRows("dv_battery", ca.horzcat(*nappes).T),
    ]


def state_blocks(
    problem: FlybyProblem,
    facets: Facets | None,
    spread: Spread | None,
    node: Sequence[ca.MX],
    *,
    printed: bool,
) -> Iterator[NlpRows]:
    """State constraints on y = (mean, entries of the spread) of every node.

    Args:
        problem: the constraints.
        facets: of P2; None for P3.
        spread: the form of the covariance; None for P3 and for P2 without a single facet.
        node: y of every node.
        printed: P3's cones by ratios.
    """
    mean = ca.horzcat(*(y[:3] for y in node))
    if facets is None:
        yield from _set_blocks(problem, mean, printed)
    elif spread is not None:
        yield from _facet_blocks(problem, facets, mean, _deviations(spread, facets, node))


def _set_blocks(problem: FlybyProblem, position: ca.MX, printed: bool) -> Iterator[NlpRows]:
    """P3: positions (3, n_nodes) in or out of every region."""
    for constraint in problem.constraints:
        inside = _inside(constraint, position[:, constraint.nodes.tolist()], printed).T
        yield NlpRows(constraint.name, inside if constraint.keep == "in" else -inside)


def _facet_blocks(
    problem: FlybyProblem, facets: Facets, position: ca.MX, deviation: ca.MX
) -> Iterator[NlpRows]:
    """P2: b - a'r - q ||S'a|| for positions (3, n_nodes) and deviations (m,)."""
    along = ca.sum1(position[:, facets.node.tolist()] * facets.normal.T).T
    margin: ca.MX = ca.DM(facets.offset) - along - ca.DM(facets.quantile) * deviation
    for index, constraint in enumerate(problem.constraints):
        rows = np.flatnonzero(facets.constraint == index)
        if len(rows):
            yield NlpRows(constraint.name, margin[rows.tolist()])


def _deviations(spread: Spread, facets: Facets, node: Sequence[ca.MX]) -> ca.MX:
    """Standard deviation along every facet's normal, (m,)."""
    parts, order = [], []
    for k in np.unique(facets.node):
        rows = np.flatnonzero(facets.node == k)
        parts.append(spread.deviation(facets.normal[rows], node[k][6:]))
        order.append(rows)
    return ca.vertcat(*parts)[np.argsort(np.concatenate(order)).tolist()]


def _nappes(problem: FlybyProblem) -> tuple[Array, Array]:
    toward, away = problem.burn_cones
    return toward.axis, away.axis


def _inside(constraint: StateConstraint, position: ca.MX, printed: bool) -> ca.MX:
    region = constraint.region
    if isinstance(region, Ball):
        return region.radius - _norm(position - region.center.T)
    return _inside_cone(position - region.apex.T, region.axis, region.half_angle, printed)


def _inside_cone(offset: ca.MX, axis: Array, half_angle: float, printed: bool) -> ca.MX:
    """Row (1, n) for offsets (3, n) from the apex: distance inside, or cosine less the limit's."""
    along = ca.sum1(offset * axis.T)
    if printed:
        return along / _norm(offset) - np.cos(half_angle)
    across = _norm(offset - axis.T * ca.repmat(along, 3, 1))
    return np.sin(half_angle) * along - np.cos(half_angle) * across


def _norm(columns: ca.MX) -> ca.MX:
    return root(ca.sum1(columns**2))
