"""Rows of P2: facets that hold with their share of the probability."""

from __future__ import annotations

from functools import cached_property

import numpy as np
import numpy.typing as npt
import scipy.sparse as sp

from formulations.linearisation.condensation import Sensitivity
from formulations.linearisation.linearisation import Linearisation
from formulations.problem.facets import Facets
from formulations.problem.flyby import FlybyProblem
from formulations.problem.regions import Array
from formulations.rows.cones import (
    NEAR_LENGTH,
    Cones,
    Margins,
    Pulled,
    Unit,
    burn_components_before,
)
from formulations.rows.final_spread import FinalSpread


class ChanceRows:
    """Chance constraints on fixed facets: a'mu + q ||S'a|| <= b + buffer, a second-order cone each.

    Args:
        problem: names the constraints.
        facets: every facet.
        included: mask of the facets that the convex program carries, shape (m,).
    """

    with_factor = True
    near = NEAR_LENGTH
    unit: Unit = "length"
    resolution = 0.0

    def __init__(
        self, problem: FlybyProblem, facets: Facets, included: npt.NDArray[np.bool_]
    ) -> None:
        self.problem = problem
        self.facets = facets
        self.included = included
        self.carried = facets.chosen(included)
        self.final = FinalSpread(problem, len(self.carried.node))
        self.nodes = np.union1d(self.carried.node, self.final.nodes)
        self.count = len(self.carried.node) + self.final.count

    def margins(self, lin: Linearisation) -> dict[str, Margins]:
        """What is left of b - a'mu after q ||S'a||, of the included facets."""
        margin = self.carried.margin(lin.iterate.mean, lin.factor)
        ends = np.searchsorted(
            self.carried.constraint, np.arange(len(self.problem.constraints) + 1)
        )
        return {
            c.name: Margins(self.carried.node[first:last], margin[first:last])
            for c, first, last in zip(self.problem.constraints, ends, ends[1:], strict=False)
        } | self.final.margins(lin)

    def missed(self, lin: Linearisation, tolerance: float) -> npt.NDArray[np.bool_]:
        """Facets left out of the program that the iterate violates by more than `tolerance`."""
        margin = self.facets.margin(lin.iterate.mean, lin.factor)
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
        """All facets. Of ||S'a|| = ||M (z', 1)|| only the triangular factor of M = Q R is kept.

        Q preserves the norm, and R has one row for each burn component that the node feels and one
        more, instead of one for each column of S.
        """
        del lin
        blocks, carried = [], self.carried
        components = burn_components_before(self.problem, self.nodes)
        for p in np.unique(components):
            nodes = np.flatnonzero(components == p)
            rows = np.flatnonzero(np.isin(carried.node, self.nodes[nodes]))
            if len(rows) == 0:  # the last node, looked at for its spread alone
                continue
            pick = self.pick[rows][:, (3 * nodes[:, None] + np.arange(3)).ravel()]
            c = self.problem.columns_before(int(p) // 3)
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
        return blocks + self.final.cones(s)

    def pulled(self, lin: Linearisation, prices: Array) -> Pulled:
        """Of a'mu + q ||S'a||: a in the mean, q a (S'a)' / ||S'a|| in the factor."""
        carried, node = self.carried, self.carried.node
        spread = np.einsum("ri,ric->rc", carried.normal, lin.factor[node, :3])
        size = np.maximum(np.linalg.norm(spread, axis=1), 1e-300)
        weighted = prices[: len(node), None] * carried.normal
        along = (carried.quantile / size)[:, None] * spread
        by_mean = np.zeros((self.problem.n_nodes, 3))
        by_factor = np.zeros((self.problem.n_nodes, 3, spread.shape[1]))
        np.add.at(by_mean, node, weighted)
        np.add.at(by_factor, node, weighted[:, :, None] * along[:, None])
        return self.final.pulled(Pulled(by_mean, by_factor), lin, prices)
