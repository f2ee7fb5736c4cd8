"""Express the law of a flight in few numbers: its first state, and velocities after later burns."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.linalg import solve_triangular

from formulations.arrays import Array
from formulations.problem.motion import with_parameters
from formulations.rows.flight_probability import FlightProbability, FlightQuantile, Limits

CERTAIN = 1e-9
"""Standard deviation that is added to each coordinate, so that certain ones have a direction."""

DIRECTED = 1e-2
"""The same relative to a coordinate's own deviation, with corrected burns. A burn that has vanished
with its gains adds nothing to a velocity. The direction of such a coordinate would turn with every
step, and with it the lines of flights."""


@dataclass(frozen=True, eq=False)
class FlightValue:
    """g = Phi^-1(P) of the whole flight, and its derivatives in means and factors at all nodes.

    Attributes:
        value: g.
        limits: limits evaluated.
        ends: share of the flights that each limit's node ends, in density.
        by_mean: shape (n_nodes, 3).
        by_factor: by the state's rows of the factors, shape (n_nodes, 6, c).
    """

    value: float
    limits: Limits
    ends: Array
    by_mean: Array
    by_factor: Array


class Coordinates:
    """Numbers in which a flight's positions are linear, and the root of their law.

    They are the state at the first of the nodes at which the flight's legs start, the velocities at the
    others, and the uncertain parameters. Factors have rows of the state and of the p parameters.

    Y are the rows of the covariance factor that belong to them, W the triangular root of Y Y'. With
    R = W^-1 Y a factor S is (S R') R, so that S R' has its covariance in fewer columns.
    """

    def __init__(self, starts: Sequence[int], parameters: int = 0) -> None:
        first, *later = starts
        few = 6 + parameters
        self._node = np.r_[[first] * few, np.repeat(later, 3)].astype(np.intp)
        self._row = np.r_[np.arange(few), np.tile([3, 4, 5], len(later))].astype(np.intp)
        self._turning = self._row < 6  # parameters are constant
        self.count, self.nodes = len(self._node), np.unique(self._node)
        self._certain = np.full(self.count, CERTAIN)

    def settle(self, factor: Array) -> None:
        """Keep coordinates that a factor leaves nearly certain from turning near it."""
        own = np.linalg.norm(factor[self._node, self._row], axis=1)
        self._certain = np.maximum(CERTAIN, DIRECTED * own)

    def __call__(
        self, probability: FlightProbability, mean: Array, factor: Array, limits: Limits | None
    ) -> FlightValue:
        """G for means (n_nodes, 3) and factors (n_nodes, 6 + p, c) at all nodes."""
        if limits is None:
            limits = probability.limits(mean, self.reduced(factor))
        return self.of_many(probability, mean[None], factor[None], limits)[0]

    def of_many(
        self, probability: FlightProbability, mean: Array, factor: Array, limits: Limits
    ) -> list[FlightValue]:
        """G of b flights by the same limits, from (b, n_nodes, 3) and (b, n_nodes, 6 + p, c)."""
        roots = [self._root(one) for one in factor]
        reduced = [self._reduced(one, rows) for one, (_, rows) in zip(factor, roots, strict=True)]
        found = probability.of_many(mean, np.stack(reduced), limits)
        parts = zip(found, factor, reduced, roots, strict=True)
        return [self._value(g, one, few, *root) for g, one, few, root in parts]

    def _value(
        self, g: FlightQuantile, factor: Array, reduced: Array, root: Array, rows: Array
    ) -> FlightValue:
        """G with derivatives at all nodes from those in the coordinates, whose W and R are given."""
        n, size, columns = factor.shape
        by_mean, by_factor = np.zeros((n, 3)), np.zeros((n, 6, columns))
        np.add.at(by_mean, g.nodes, g.by_mean)
        nodes, which = np.unique(g.nodes, return_inverse=True)
        here = np.zeros((len(nodes), size - 3, self.count))
        np.add.at(here, which, g.by_factor)
        by_factor[nodes, :3] = here[:, :3] @ rows
        # What turning the coordinates does to directions that stay as they are: W has a derivative,
        # W low(A + A') with A = W^-1 dY R', where W A is already counted.
        turned = np.tensordot(reduced[nodes], here, axes=([0, 1], [0, 1]))
        turned = np.triu(turned.T - turned, 1)
        by_own = solve_triangular(root, turned @ rows, lower=True, trans="T")
        own = self._turning
        np.add.at(by_factor, (self._node[own], self._row[own]), by_own[own])
        return FlightValue(g.value, g.limits, g.ends, by_mean, by_factor)

    def reduced(self, factor: Array) -> Array:
        """Factors of positions and parameters in fewer columns, S R', (n_nodes, 3 + p, count)."""
        return self._reduced(factor, self._root(factor)[1])

    def _reduced(self, factor: Array, rows: Array) -> Array:
        own = with_parameters(factor)
        flat = own.reshape(-1, factor.shape[2])
        return np.asarray(flat @ rows.T).reshape(*own.shape[:2], self.count)

    def _root(self, factor: Array) -> tuple[Array, Array]:
        """W and R, by an orthogonal factorisation, which bears any ratio of standard deviations."""
        own = factor[self._node, self._row]
        across, up = np.linalg.qr(np.hstack([own, np.diag(self._certain)]).T)
        sign = np.copysign(1.0, np.diag(up))
        return (sign[:, None] * up).T, (across * sign).T[:, : own.shape[1]]
