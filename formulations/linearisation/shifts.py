"""Derivatives of mean and covariance factor by firing times and phases.

With f the rate of the state, D = df/dx, and - and + before and after a burn dv, a burn that comes dt
later changes mean and factor right after it, at given times, by

    (f- - f+) dt = -[dv, a+ - a-] dt,        (D- S- - D+ S+) dt,

a the acceleration. Where a does not depend on the velocity, D- = D+ = D and these are -[dv, 0] dt and
-D B C(dv) dt. What follows is carried on by the STMs and second-order tensors, as the burns' own
changes are. Nodes that move along with a burn see f dt and D S dt in addition. Before the first burn,
and after the last, the boundary state holds whenever that is: f = 0 and D = 0 there. A phase moves
boundary state and initial factor as its orbit says.

The factor E of the estimate's error changes in the same way, (D- E- - D+ E+) dt at a burn; and a
cut-off that moves along with its burn sees D E dt before its measurement.

These are the derivatives of the flow itself. Those of its Runge-Kutta scheme differ by the scheme's
error per unit of time.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import cast

import numpy as np

from formulations.arrays import Array, Indices
from formulations.linearisation.factor import Shifted, Spread, after_measurements
from formulations.problem.controls import UNIT, FiringTimes
from formulations.problem.flow import ArcDerivatives, MovableDerivatives
from formulations.problem.flyby import FlybyProblem, Iterate


@dataclass(frozen=True, eq=False)
class Shifts:
    """Derivatives by the firing times and phases of a problem that has some, in `controls.UNIT`.

    Attributes:
        problem: of the iterate.
        iterate: burns, means and times.
        arcs: the iterate's arcs, whose flow gives the state's rate.
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
        """Rates f (n, 6) and their derivatives D (n, 6, 6 + p) at the starts of the n arcs."""
        arcs = np.arange(self.problem.n_nodes - 1)
        return cast("MovableDerivatives", self.arcs).rate(self.iterate.mean[:-1], arcs)

    @cached_property
    def _about(self) -> tuple[tuple[Array, Array], tuple[Array, Array]]:
        """The same before and after burns that move, (q, 6) and (q, 6, 6 + p); at the ends zero."""
        nodes = self.problem.burn_nodes[self._firing.burns]
        inner, flies = nodes > 0, nodes < self.problem.n_nodes - 1
        size = 6 + self.problem.parameters
        before, after = (np.zeros((len(nodes), 6)), np.zeros((len(nodes), 6, size))), self._rates
        rates = cast("MovableDerivatives", self.arcs).rate
        found = rates(self.arcs.state[nodes[inner] - 1], nodes[inner])
        for whole, part in zip(before, found, strict=True):
            whole[inner] = part
        ends = [np.zeros((len(nodes), *part.shape[1:])) for part in after]
        for whole, part in zip(ends, after, strict=True):
            whole[flies] = part[nodes[flies]]
        return before, (ends[0], ends[1])

    @cached_property
    def _slopes(self) -> tuple[Array, Array, Array] | None:
        """Derivatives of the boundary by its phases; see `Boundary.slopes`."""
        firing = self._firing
        if firing.boundary is None:
            return None
        times = self.problem.firing_times(self.iterate.times)
        return firing.boundary.slopes(firing.phases(times))

    def _phase(self, which: int) -> int | None:
        """Number of the control that is a boundary's phase, 0 or 1; None if it is not free."""
        firing = self._firing
        if firing.boundary is None or which not in firing.boundary.free:
            return None
        return len(firing.burns) + firing.boundary.free.index(which)

    @cached_property
    def mean(self) -> Array:
        """Change of the mean after each burn at given times, shape (m, 6, q)."""
        problem, burns = self.problem, self._firing.burns
        change = np.zeros((problem.n_burns, 6, self._firing.shares.shape[1]))
        (before, _), (after, _) = self._about
        change[burns, :, range(len(burns))] = UNIT * (before - after)
        if self._slopes is not None and (phase := self._phase(0)) is not None:
            change[0, :, phase] = UNIT * self._slopes[0]
        return change

    @cached_property
    def final(self) -> Array:
        """Change of the final state that is to be met, shape (6, q)."""
        change = np.zeros((6, self._firing.shares.shape[1]))
        if self._slopes is not None and (phase := self._phase(1)) is not None:
            change[:, phase] = UNIT * self._slopes[2]
        return change

    def factor(self, spread: Spread) -> Shifted:
        """The same of the factors of deviation and estimate's error, from those of the iterate."""
        problem, starts = self.problem, self.problem.leg_starts
        shape = 6, problem.factor_columns, self._firing.shares.shape[1]
        first, change = np.zeros(shape), np.zeros((2, problem.n_burns, *shape))
        (_, before), (_, after) = self._about
        for j, burn in enumerate(self._firing.burns):
            leg, node = burn + problem.coasts, problem.burn_nodes[burn]
            pairs = [(spread.factor[node], spread.factor[starts[leg - 1]])]
            if problem.feedback is not None:
                known = after_measurements(problem, spread, leg - 1)
                pairs.append((spread.leg_errors[leg], known))
            for part, (here, left) in zip(change, pairs, strict=False):
                turned = before[j] @ spread.stm[node] @ left - after[j] @ here
                part[burn, ..., j] = UNIT * turned
        if self._slopes is not None and (phase := self._phase(0)) is not None:
            slope = self._slopes[1][:6]
            change[0, 0, :, : slope.shape[1], phase] = UNIT * slope
            first[:, : slope.shape[1], phase] = UNIT * slope
        measured = [self._measured(spread, j) for j in range(len(spread.innovations))]
        return Shifted(first, change[0], change[1], np.reshape(measured, (-1, *shape)))

    def _measured(self, spread: Spread, j: int) -> Array:
        """What the cut-off of the corrected burn j sees of its error's rate, (6, c, q)."""
        assert self.problem.feedback is not None
        node = int(self.problem.feedback.cut_offs[j])
        error = spread.stm[node] @ spread.errors[j]
        for burn in np.flatnonzero(self.problem.burn_nodes == node):
            return self.before(int(burn), error)[1]
        return self.factor_drift(np.array([node]), error[None])[0]

    def drift(self, nodes: Indices) -> Array:
        """What nodes see of the mean's rate as they move along, shape (n, 6, q)."""
        found = np.zeros((len(nodes), 6, self._firing.shares.shape[1]))
        moved = nodes < self.problem.n_nodes - 1
        here = nodes[moved]
        found[moved] = UNIT * self._rates[0][here, :, None] * self._firing.shares[here, None]
        return found

    def before(self, burn: int, factor: Array) -> tuple[Array, Array]:
        """What a burn's node sees of both rates just before the burn, (6, q) and (6, c, q).

        `factor` is the iterate's there, (6 + p, c).
        """
        q = self._firing.shares.shape[1]
        mean, turned = np.zeros((6, q)), np.zeros((6, factor.shape[1], q))
        if burn in self._firing.burns:
            j = int(np.searchsorted(self._firing.burns, burn))
            rate, turn = self._about[0]
            mean[:, j], turned[..., j] = UNIT * rate[j], UNIT * turn[j] @ factor
        return mean, turned

    def factor_drift(self, nodes: Indices, factor: Array) -> Array:
        """The same of the factor's rate, (n, 6, c, q), of factors (n, 6 + p, c) at these nodes."""
        found = np.zeros((len(nodes), 6, factor.shape[2], self._firing.shares.shape[1]))
        moved = nodes < self.problem.n_nodes - 1
        here = nodes[moved]
        turned = self._rates[1][here] @ factor[moved]
        found[moved] = UNIT * turned[..., None] * self._firing.shares[here, None, None]
        return found
