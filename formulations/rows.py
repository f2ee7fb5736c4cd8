"""Rows of P3 and of P2: the state constraints, over the positions of nodes and their factors."""

from __future__ import annotations

from functools import cached_property
from typing import Literal, NamedTuple, Protocol

import numpy as np
import numpy.typing as npt
import scipy.sparse as sp

from formulations.facets import Facets
from formulations.lifting import Linearisation, Sensitivity
from formulations.problem import FlybyProblem, Nodes
from formulations.regions import Array


class Margins(NamedTuple):
    """Margins of one constraint's rows (>= 0 where satisfied) and the nodes they belong to."""

    nodes: Nodes
    margin: Array


class Cones(NamedTuple):
    """Second-order cones in the burns: y = values z' + constants has y_0 + buffer >= ||y_1..||.

    They are of one dimension d (d = 1: half-spaces) and feel the first p burn components z' only.

    Attributes:
        rows: which of the buffers each has, shape (n,).
        values: shape (n, d, p).
        constants: shape (n, d).
        triangular: whether the last d - 1 rows of [values, constants] are zero below the diagonal.
    """

    rows: Nodes
    values: Array
    constants: Array
    triangular: bool = False


class Rows(Protocol):
    """What a subproblem asks of its state constraints."""

    @property
    def nodes(self) -> Nodes:
        """Nodes that the rows look at, ascending."""
        ...

    @property
    def with_factor(self) -> bool:
        """Whether they look at the covariance factor."""
        ...

    @property
    def count(self) -> int:
        """Number of rows, and of buffers."""
        ...

    def margins(self, lin: Linearisation) -> dict[str, Margins]:
        """Margins by constraint name from the nonlinear mean and factor, never from the model."""
        ...

    def cones(self, lin: Linearisation, s: Sensitivity) -> list[Cones]:
        """The rows, convexified at an iterate, for mean and factor at `nodes` affine in the burns."""
        ...


def felt(problem: FlybyProblem, nodes: Nodes) -> Nodes:
    """How many burn components the positions at some nodes depend on: those of the burns before.

    At least a burn's, so that no cone is without them.
    """
    return 3 * np.maximum(np.searchsorted(problem.burn_nodes, nodes), 1)


class P3Rows:
    """Deterministic constraints: keep-in sets as cones, keep-out sets by their supporting plane.

    The plane that touches the region nearest to the iterate is its linearisation and an inner
    approximation of the complement at once.
    """

    with_factor = False

    def __init__(self, problem: FlybyProblem) -> None:
        self.problem = problem
        used = [c.nodes for c in problem.constraints]
        self.nodes = np.unique(np.concatenate(used)) if used else np.zeros(0, dtype=np.intp)
        self.count = sum(len(nodes) for nodes in used)

    def margins(self, lin: Linearisation) -> dict[str, Margins]:
        """Signed distances of the mean to the regions."""
        constraints = self.problem.constraints
        return {c.name: Margins(c.nodes, c.margin(lin.iterate.mean)) for c in constraints}

    def cones(self, lin: Linearisation, s: Sensitivity) -> list[Cones]:
        """One cone per keep-in node, one half-space per keep-out node, each kind in one block."""
        found: dict[Literal["in", "out"], list[Cones]] = {"in": [], "out": []}
        first = 0
        for c in self.problem.constraints:
            at = np.searchsorted(self.nodes, c.nodes)
            position, jacobian = s.mean_constant[at, :3], s.mean_jacobian[at, :3]
            if c.keep == "out":
                planes = c.region.supporting(lin.iterate.mean[c.nodes, :3])
                matrix = planes.normal[:, None]
                constants = (matrix @ position[:, :, None])[:, :, 0] - planes.offset[:, None]
            else:
                cone = c.region.second_order_cone
                matrix = np.concatenate([cone.linear[:, None], cone.matrix], axis=1)
                constants = (matrix @ (position - cone.origin)[:, :, None])[:, :, 0]
                constants[:, 0] += cone.constant
            rows = first + np.arange(len(c.nodes))
            values = matrix @ jacobian[:, :, : felt(self.problem, c.nodes).max()]
            found[c.keep].append(Cones(rows, values, constants))
            first += len(rows)
        return [_joined(cones) for cones in found.values() if cones]


def _joined(blocks: list[Cones]) -> Cones:
    """Blocks of one dimension as one, which feels what the one that feels most does."""
    p = max(block.values.shape[2] for block in blocks)
    values = [np.pad(b.values, ((0, 0), (0, 0), (0, p - b.values.shape[2]))) for b in blocks]
    return Cones(
        np.concatenate([block.rows for block in blocks]),
        np.concatenate(values),
        np.concatenate([block.constants for block in blocks]),
    )


class P2Rows:
    """Chance constraints on fixed facets: a'mu + q ||S'a|| <= b + buffer, a second-order cone each.

    Args:
        problem: names the constraints.
        facets: every facet.
        included: mask of the facets that the convex program carries, shape (m,).
    """

    with_factor = True

    def __init__(
        self, problem: FlybyProblem, facets: Facets, included: npt.NDArray[np.bool_]
    ) -> None:
        self.problem = problem
        self.facets = facets
        self.included = included
        self.carried = facets.chosen(included)
        self.nodes = np.unique(self.carried.node)
        self.count = len(self.carried.node)

    def margins(self, lin: Linearisation) -> dict[str, Margins]:
        """B - a'mu - q ||S'a|| of the included facets."""
        margin = self.carried.margin(lin.iterate.mean, lin.factor)
        ends = np.searchsorted(
            self.carried.constraint, np.arange(len(self.problem.constraints) + 1)
        )
        return {
            c.name: Margins(self.carried.node[first:last], margin[first:last])
            for c, first, last in zip(self.problem.constraints, ends, ends[1:], strict=False)
        }

    def missed(self, lin: Linearisation, tolerance: float) -> npt.NDArray[np.bool_]:
        """Facets left out of the program that the iterate violates by more than `tolerance`."""
        margin = self.facets.margin(lin.iterate.mean, lin.factor)
        return ~self.included & (margin < -tolerance)

    @cached_property
    def pick(self) -> sp.csr_array:
        """A'r of every facet from the stacked positions r of all `nodes`, shape (count, 3 n)."""
        columns = 3 * np.searchsorted(self.nodes, self.carried.node)[:, None] + np.arange(3)
        indices = np.repeat(np.arange(self.count), 3), columns.ravel()
        shape = (self.count, 3 * len(self.nodes))
        return sp.csr_array((self.carried.normal.ravel(), indices), shape=shape)

    def cones(self, lin: Linearisation, s: Sensitivity) -> list[Cones]:
        """All facets. Of ||S'a|| = ||M (z', 1)|| only the triangular factor of M = Q R is kept.

        Q preserves the norm, and R has one row for each burn component that the node feels and one
        more, instead of one for each column of S.
        """
        del lin
        blocks, carried = [], self.carried
        components = felt(self.problem, self.nodes)
        for p in np.unique(components):
            nodes = np.flatnonzero(components == p)
            rows = np.flatnonzero(np.isin(carried.node, self.nodes[nodes]))
            pick = self.pick[rows][:, (3 * nodes[:, None] + np.arange(3)).ravel()]
            c = self.problem.initial_factor.shape[1] + int(p)
            spread = np.concatenate(
                [s.factor_jacobian[nodes, :3, :c, :p], s.factor_constant[nodes, :3, :c, None]], -1
            )
            spread = (pick @ spread.reshape(3 * len(nodes), -1)).reshape(-1, c, p + 1)
            spread *= carried.quantile[rows, None, None]
            mean = np.concatenate(
                [s.mean_jacobian[nodes, :3, :p], s.mean_constant[nodes, :3, None]], axis=2
            )
            room = -(pick @ mean.reshape(3 * len(nodes), -1))
            room[:, -1] += carried.offset[rows]
            triangle = np.asarray(np.linalg.qr(spread, mode="r"))
            both = np.concatenate([room[:, None], triangle], axis=1)
            blocks.append(Cones(rows, both[..., :-1], both[..., -1], triangular=True))
        return blocks
