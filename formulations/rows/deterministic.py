"""Rows of P3: the regions themselves, without uncertainty."""

from __future__ import annotations

from typing import Literal

import numpy as np

from formulations.linearisation.condensation import Sensitivity
from formulations.linearisation.linearisation import Linearisation
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


class DeterministicRows:
    """Deterministic constraints: keep-in sets as cones, keep-out sets by their supporting plane.

    The plane that touches the region nearest to the iterate is its linearisation and an inner
    approximation of the complement at once.
    """

    with_factor = False
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
            values = matrix @ jacobian[:, :, : burn_components_before(self.problem, c.nodes).max()]
            found[c.keep].append(Cones(rows, values, constants))
            first += len(rows)
        return [_joined(cones) for cones in found.values() if cones]

    def pulled(self, lin: Linearisation, prices: Array) -> Pulled:
        """Of the keep-in cones and of the keep-out sets' supporting planes; no factor."""
        by_mean, first = np.zeros((self.problem.n_nodes, 3)), 0
        for c in self.problem.constraints:
            position, price = lin.iterate.mean[c.nodes, :3], prices[first : first + len(c.nodes)]
            if c.keep == "out":
                slope = -c.region.supporting(position).normal
            else:
                cone = c.region.second_order_cone
                across = np.einsum("nij,nj->ni", cone.matrix, position - cone.origin)
                size = np.maximum(np.linalg.norm(across, axis=1), 1e-300)
                slope = np.einsum("ni,nij->nj", across / size[:, None], cone.matrix) - cone.linear
            np.add.at(by_mean, c.nodes, price[:, None] * slope)
            first += len(c.nodes)
        return Pulled(by_mean, np.zeros((self.problem.n_nodes, 3, 0)))


def _joined(blocks: list[Cones]) -> Cones:
    """Blocks of one dimension as one, which feels what the one that feels most does."""
    rows = np.concatenate([block.rows for block in blocks])
    _, d, p = np.max([block.values.shape for block in blocks], axis=0)
    values, first = np.zeros((len(rows), d, p)), 0
    for block in blocks:
        last = first + len(block.rows)
        values[first:last, :, : block.values.shape[2]] = block.values
        first = last
    return Cones(
        rows,
        values,
        np.concatenate([block.constants for block in blocks]),
    )
