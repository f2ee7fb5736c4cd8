"""Rows of P3, made of the regions themselves, and of P2 with evenly split risk, made of facets."""

from __future__ import annotations

from functools import cached_property
from typing import Literal

import numpy as np
import scipy.sparse as sp

from formulations.arrays import Array, Booleans, Indices
from formulations.linearisation.linearisation import Linearisation, Sensitivity
from formulations.problem.facets import Facets
from formulations.problem.flyby import FlybyProblem, StateConstraint, factor_columns_used
from formulations.problem.regions import SecondOrderCone
from formulations.rows.cones import (
    NEAR_LENGTH,
    POSITION,
    Cones,
    Margins,
    Unit,
    controls_felt,
    placed,
    triangular_cones,
)
from formulations.rows.corrected_burns import FurtherRows


class DeterministicRows:
    """Deterministic constraints: keep-in sets as cones, keep-out sets by their supporting plane.

    The plane touches the region at its point nearest to the iterate. It linearises the region and
    is also an inner approximation of the complement.
    """

    with_factor = condensed = False
    near = NEAR_LENGTH
    unit: Unit = "length"

    def __init__(self, problem: FlybyProblem, resolution: float = 0.0) -> None:
        self.problem = problem
        self.resolution = resolution
        used = [c.nodes for c in problem.constraints]
        self.nodes = np.unique(np.concatenate(used)) if used else np.zeros(0, dtype=np.intp)
        self.count = sum(len(nodes) for nodes in used)

    def margins(self, lin: Linearisation) -> dict[str, Margins]:
        """Signed distances of the mean to the regions."""
        constraints = self.problem.constraints
        return {c.name: Margins(c.nodes, c.margin(lin.iterate.mean)) for c in constraints}

    def cones(self, lin: Linearisation, s: Sensitivity) -> list[Cones]:
        """One cone per keep-in node and one half-space per keep-out node, one block of each."""
        blocks: dict[Literal["in", "out"], list[Cones]] = {"in": [], "out": []}
        first = 0
        for c in self.problem.constraints:
            at = np.searchsorted(self.nodes, c.nodes)
            position, jacobian = s.mean_constant[at, :3], s.mean_jacobian[at, :3]
            matrix, origin, offset = _map_of(c, lin)
            constants = (matrix @ (position - origin)[:, :, None])[:, :, 0] + offset
            rows = first + np.arange(len(c.nodes))
            values = matrix @ jacobian[:, :, : controls_felt(self.problem, c.nodes).max()]
            blocks[c.keep].append(Cones(rows, values, constants))
            first += len(rows)
        return [_joined(cones) for cones in blocks.values() if cones]

    def state_cones(self, lin: Linearisation) -> list[Cones]:
        """One block of cones for each constraint, as in `cones`."""
        blocks, first = [], 0
        for c in self.problem.constraints:
            matrix, origin, offset = _map_of(c, lin)
            n, d, _ = matrix.shape
            y = np.arange(n * d).reshape(n, d, 1)
            places = placed(y, c.nodes[:, None, None], POSITION[:, 0], np.array(0))
            rows, none = first + np.arange(n), np.zeros((n, d, 0))
            constants = offset - (matrix @ origin[:, :, None])[:, :, 0]
            blocks.append(Cones(rows, none, constants, places=places, entries=matrix.ravel()))
            first += n
        return blocks


def _map_of(constraint: StateConstraint, lin: Linearisation) -> SecondOrderCone:
    """Maps from positions r to y = matrix (r - origin) + offset; (n, d, 3), (n, 3) and (n, d)."""
    if constraint.keep == "in":
        return constraint.region.second_order_cone
    planes = constraint.region.supporting(lin.iterate.mean[constraint.nodes, :3])
    return planes.normal[:, None], np.zeros_like(planes.normal), -planes.offset[:, None]


def _joined(blocks: list[Cones]) -> Cones:
    """Join blocks of one dimension into one, in the most burn components of any."""
    rows = np.concatenate([block.rows for block in blocks])
    _, d, p = np.max([block.values.shape for block in blocks], axis=0)
    values, first = np.zeros((len(rows), d, p)), 0
    for block in blocks:
        last = first + len(block.rows)
        values[first:last, :, : block.values.shape[2]] = block.values
        first = last
    return Cones(rows, values, np.concatenate([block.constants for block in blocks]))


class ChanceRows:
    """Chance constraints on fixed facets: a'mu + q ||S'a|| <= b + buffer, a second-order cone each.

    `included` masks the facets in the convex program.
    """

    with_factor = condensed = True
    near = NEAR_LENGTH
    unit: Unit = "length"

    def __init__(
        self, problem: FlybyProblem, facets: Facets, included: Booleans, resolution: float = 0.0
    ) -> None:
        self.problem, self.resolution = problem, resolution
        self.facets = facets
        self.included = included
        self.carried = facets.chosen(included)
        self.further = FurtherRows(problem, len(self.carried.node))
        self.nodes = np.union1d(self.carried.node, self.further.nodes)
        self.count = len(self.carried.node) + self.further.count

    def margins(self, lin: Linearisation) -> dict[str, Margins]:
        """Margins b - a'mu - q ||S'a|| of the included facets."""
        margin = self.carried.margin(lin.iterate.mean, lin.spread.factor)
        ends = np.searchsorted(
            self.carried.constraint, np.arange(len(self.problem.constraints) + 1)
        )
        return {
            c.name: Margins(self.carried.node[first:last], margin[first:last])
            for c, first, last in zip(self.problem.constraints, ends, ends[1:], strict=False)
        } | self.further.margins(lin)

    def missed(self, lin: Linearisation, tolerance: float) -> Booleans:
        """Facets left out of the program that the iterate violates by more than `tolerance`."""
        margin = self.facets.margin(lin.iterate.mean, lin.spread.factor)
        return ~self.included & (margin < -tolerance)

    @cached_property
    def pick(self) -> sp.csr_array:
        """Map to a'r of every facet from all positions r at `nodes` stacked, shape (facets, 3 n)."""
        columns = 3 * np.searchsorted(self.nodes, self.carried.node)[:, None] + np.arange(3)
        facets = len(self.carried.node)
        indices = np.repeat(np.arange(facets), 3), columns.ravel()
        shape = (facets, 3 * len(self.nodes))
        return sp.csr_array((self.carried.normal.ravel(), indices), shape=shape)

    def cones(self, lin: Linearisation, s: Sensitivity) -> list[Cones]:
        """Cones of all facets, in a block for each number of burn components on which nodes depend."""
        blocks, carried = [], self.carried
        felt = controls_felt(self.problem, self.nodes)
        for p in np.unique(felt):
            nodes = np.flatnonzero(felt == p)
            rows = np.flatnonzero(np.isin(carried.node, self.nodes[nodes]))
            if len(rows) == 0:  # the last node, looked at for its spread alone
                continue
            pick = self.pick[rows][:, (3 * nodes[:, None] + np.arange(3)).ravel()]
            c = factor_columns_used(self.problem, self.nodes[nodes])
            spread = np.concatenate(
                [s.factor_jacobian[nodes, :3, :c, :p], s.factor_constant[nodes, :3, :c, None]], -1
            )
            spread = (pick @ spread.reshape(3 * len(nodes), -1)).reshape(-1, c, p + 1)
            if carried.motion is not None:
                at = np.searchsorted(self.nodes, carried.node[rows])
                slope, still = self._moved(rows, s.mean_constant[at, :3], c)
                spread[:, :, :p] += slope.swapaxes(1, 2) @ s.mean_jacobian[at, :3, :p]
                spread[:, :, p] += still
            spread *= carried.quantile[rows, None, None]
            mean = np.concatenate(
                [s.mean_jacobian[nodes, :3, :p], s.mean_constant[nodes, :3, None]], axis=2
            )
            room = -(pick @ mean.reshape(3 * len(nodes), -1))
            room[:, -1] += carried.offset[rows]
            blocks.append(triangular_cones(rows, room, spread))
        return blocks + self.further.cones(lin, s)

    def state_cones(self, lin: Linearisation) -> list[Cones]:
        """All facets in one block; their numbers are those of the facets."""
        carried, n = self.carried, len(self.carried.node)
        if n == 0:
            return self.further.state_cones(lin)
        columns = factor_columns_used(self.problem, np.unique(carried.node))
        d = 1 + columns
        y = np.arange(n * d).reshape(n, 1, d)
        weight = np.column_stack([-np.ones(n), np.repeat(carried.quantile[:, None], columns, 1)])
        entries = (carried.normal[:, :, None] * weight[:, None]).ravel()
        constants = carried.offset[:, None] * np.eye(1, d)
        places = placed(y, carried.node[:, None, None], POSITION, np.arange(d))
        if carried.motion is not None:
            slope, still = self._moved(np.arange(n), np.zeros((n, 3)), columns)
            constants[:, 1:] += carried.quantile[:, None] * still
            entries = np.r_[entries, (carried.quantile[:, None, None] * slope).ravel()]
            mean = np.zeros(1, dtype=np.intp)
            more = placed(y[..., 1:], carried.node[:, None, None], POSITION, mean)
            places = np.hstack([places, more])
        none = np.zeros((n, d, 0))
        own = Cones(np.arange(n), none, constants, places=places, entries=entries)
        return [own, *self.further.state_cones(lin)]

    def _moved(self, rows: Indices, point: Array, columns: int) -> tuple[Array, Array]:
        """Part of some facets' S'a by the regions' motion, for points (r, 3) and first columns.

        It is affine in the position: slope (r, 3, columns) and value (r, columns).
        """
        carried, own = self.carried, self.problem.parameter_factor[:, :columns]
        assert carried.motion is not None
        motion, normal = carried.motion.at(rows), carried.normal[rows]
        value = np.einsum("ri,rip->rp", normal, motion.seen(point)) @ own
        return np.asarray(motion.slope(normal) @ own), np.asarray(value)
