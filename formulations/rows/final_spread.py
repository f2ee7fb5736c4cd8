"""Limits on the covariance after the last burn: root of the summed variances of position, of velocity.

With the covariance's factor S affine in the burns each is one second-order cone,

    ||vec(S_final)|| <= limit + buffer,

S_final the factor's rows of position or of velocity at the last node, the last burn's errors included.
"""

from __future__ import annotations

import numpy as np

from formulations.linearisation.condensation import Sensitivity
from formulations.linearisation.linearisation import Linearisation
from formulations.problem.flyby import FlybyProblem, Nodes
from formulations.problem.regions import Array
from formulations.rows.cones import Cones, Margins, Pulled

FINAL_POSITION, FINAL_VELOCITY = "final_position_sigma", "final_velocity_sigma"
PARTS = ((FINAL_POSITION, slice(0, 3)), (FINAL_VELOCITY, slice(3, 6)))


class FinalSpread:
    """The rows that a problem's `final_spread` asks for, which come after all others.

    Args:
        problem: the flyby problem.
        first: number of rows before.
    """

    def __init__(self, problem: FlybyProblem, first: int) -> None:
        limits = zip(PARTS, problem.final_spread, strict=True)
        self._limits = [(*part, limit) for part, limit in limits if limit is not None]
        self._first, self._last = first, problem.n_nodes - 1
        self.count = len(self._limits)

    @property
    def nodes(self) -> Nodes:
        """The last node, if there is a limit."""
        return np.full(min(self.count, 1), self._last, dtype=np.intp)

    def margins(self, lin: Linearisation) -> dict[str, Margins]:
        """Limits less the roots, in units of length and of speed."""
        return {
            name: Margins(self.nodes, np.array([limit - np.linalg.norm(lin.factor[-1, part])]))
            for name, part, limit in self._limits
        }

    def cones(self, s: Sensitivity) -> list[Cones]:
        """One each, in all burns; only the triangular factor of the norm's map is kept.

        Args:
            s: of nodes of which the last is the problem's last.
        """
        found = []
        for number, (_, part, limit) in enumerate(self._limits):
            jacobian = s.factor_jacobian[-1, part]
            jacobian = jacobian.reshape(-1, jacobian.shape[-1])
            both = np.column_stack([jacobian, s.factor_constant[-1, part].ravel()])
            triangle = np.linalg.qr(both, mode="r")
            head = np.r_[np.zeros(jacobian.shape[1]), limit]
            y = np.vstack([head, triangle])[None]
            rows = np.array([self._first + number])
            found.append(Cones(rows, y[..., :-1], y[..., -1], triangular=True))
        return found

    def pulled(self, others: Pulled, lin: Linearisation, prices: Array) -> Pulled:
        """What other rows pull, and these: vec(S) / ||vec(S)|| each.

        Args:
            others: of the rows before.
            lin: where.
            prices: of all rows.
        """
        if not self.count:
            return others
        by_factor = np.zeros((self._last + 1, 6, lin.factor.shape[2]))
        by_factor[:, : others.by_factor.shape[1], : others.by_factor.shape[2]] = others.by_factor
        for number, (_, part, _limit) in enumerate(self._limits):
            spread = lin.factor[-1, part]
            size = max(float(np.linalg.norm(spread)), 1e-300)
            by_factor[-1, part] += prices[self._first + number] / size * spread
        return Pulled(others.by_mean, by_factor)
