"""Derivatives of mean and covariance factor by firing times.

With f the rate of the state, D = df/dx, and - and + before and after a burn dv, a burn that comes dt
later changes mean and factor right after it, at given times, by

    (f- - f+) dt = -[dv, a+ - a-] dt,        (D- S- - D+ S+) dt,

a the acceleration. Where a does not depend on the velocity, D- = D+ = D and these are -[dv, 0] dt and
-D B C(dv) dt. What follows is carried on by the STMs and second-order tensors, as the burns' own
changes are. Nodes that move along with a burn see f dt and D S dt in addition.

These are the derivatives of the flow itself. Those of its Runge-Kutta scheme differ by the scheme's
error per unit of time.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import cast

import numpy as np

from formulations.arrays import Array, Indices
from formulations.problem.firing_times import UNIT, FiringTimes
from formulations.problem.flow import ArcDerivatives, MovableDerivatives
from formulations.problem.flyby import FlybyProblem, Iterate


@dataclass(frozen=True, eq=False)
class Shifts:
    """Derivatives by the firing times of a problem that has some, in `firing_times.UNIT`.

    Attributes:
        problem: of the iterate.
        iterate: burns, means and times.
        arcs: its arcs, whose flow tells its rate.
    """

    problem: FlybyProblem
    iterate: Iterate
    arcs: ArcDerivatives

    @property
    def _firing(self) -> FiringTimes:
        assert self.problem.firing is not None
        return self.problem.firing

    @cached_property
    def _rates(self) -> tuple[Array, Array]:
        """Rates f (n, 6) and their derivatives D (n, 6, 6) at the starts of the n arcs."""
        arcs = np.arange(self.problem.n_nodes - 1)
        return cast("MovableDerivatives", self.arcs).rate(self.iterate.mean[:-1], arcs)

    @cached_property
    def _before(self) -> tuple[Array, Array]:
        """The same before each burn that moves, (q, 6) and (q, 6, 6)."""
        nodes = self.problem.burn_nodes[self._firing.burns]
        return cast("MovableDerivatives", self.arcs).rate(self.arcs.state[nodes - 1], nodes)

    @cached_property
    def mean(self) -> Array:
        """Change of the mean after each burn at given times, shape (m, 6, q)."""
        problem, burns = self.problem, self._firing.burns
        change = np.zeros((problem.n_burns, 6, len(burns)))
        after = self._rates[0][problem.burn_nodes[burns]]
        change[burns, :, range(len(burns))] = UNIT * (self._before[0] - after)
        return change

    def factor(self, factor: Array) -> Array:
        """The same of the factor, (m, 6, c, q); `factor` is the iterate's at all nodes."""
        problem, burns = self.problem, self._firing.burns
        change = np.zeros((problem.n_burns, *factor.shape[1:], len(burns)))
        columns = problem.execution_errors.columns(self.iterate.burns)
        shared = problem.execution_errors.shared
        for j, burn in enumerate(burns):
            node, added = problem.burn_nodes[burn], np.zeros(factor.shape[1:])
            added[3:, problem.shared_columns] = columns[burn, :, :shared]
            added[3:, problem.columns_of_burn(burn)] = columns[burn, :, shared:]
            after = self._rates[1][node] @ factor[node]
            change[burn, ..., j] = UNIT * (self._before[1][j] @ (factor[node] - added) - after)
        return change

    def drift(self, nodes: Indices) -> Array:
        """What nodes see of the mean's rate as they move along, shape (n, 6, q)."""
        found = np.zeros((len(nodes), 6, len(self._firing.burns)))
        moved = nodes < self.problem.n_nodes - 1
        here = nodes[moved]
        found[moved] = UNIT * self._rates[0][here, :, None] * self._firing.shares[here, None]
        return found

    def factor_drift(self, nodes: Indices, factor: Array) -> Array:
        """The same of the factor's rate, (n, 6, c, q); `factor` is the iterate's at these nodes."""
        found = np.zeros((*factor.shape, len(self._firing.burns)))
        moved = nodes < self.problem.n_nodes - 1
        here = nodes[moved]
        turned = self._rates[1][here] @ factor[moved]
        found[moved] = UNIT * turned[..., None] * self._firing.shares[here, None, None]
        return found

    def pulled(self, by_mean: Array, by_factor: Array, factor: Array) -> Array:
        """Derivative by the times of a function through drifts alone, shape (q,).

        Args:
            by_mean: its derivatives by the means at all nodes, shape (n_nodes, 6).
            by_factor: by the factors, shape (n_nodes, 6, c).
            factor: the iterate's at all nodes.
        """
        rate, turn = self._rates
        own = np.einsum("ki,ki->k", by_mean[:-1], rate)
        own += np.einsum("kic,kij,kjc->k", by_factor[:-1], turn, factor[:-1], optimize=True)
        return np.asarray(UNIT * own @ self._firing.shares[:-1])
