"""Approximate flights by the normal law: positions at the nodes are mean + factor w.

The random numbers w are those of the flight. The law gives every draw's margin to the nearest limit, a
hundred times as fast as a flight.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from formulations.arrays import Array, Indices
from formulations.linearisation.linearisation import Linearisation
from formulations.problem.motion import with_parameters
from formulations.rows.flight_probability import Limit, Limits, limits_within
from formulations.rows.node_probability import joint_events

REACH = 5.0
"""Standard deviations from a limit beyond which the law leaves it out: a draw in three million."""

FAR = 1e6
"""Margin where no limit is within reach, m."""


@dataclass(frozen=True)
class Law:
    """Normal law of a flight's positions at the nodes, and the limits on them.

    Attributes:
        mean: positions, shape (n, 3).
        factor: of the covariance of positions and of p uncertain parameters, a column for each number
            that a flight draws, shape (n, 3 + p, sources).
        limits: that flights may break.
        length_m: of the unit of length.
        is_whole: whether a flight has one margin, the least of all nodes.
    """

    mean: Array
    factor: Array
    limits: Limits
    length_m: float
    is_whole: bool = False

    @classmethod
    def of(cls, lin: Linearisation, length_m: float, *, is_whole: bool = False) -> Law:
        """The law at an iterate, with a column for each number that its flights draw.

        Errors of executing a correction are products of two numbers, and have no column.
        """
        mean, factor = lin.iterate.mean[:, :3], with_parameters(drawn_factor(lin))
        events = joint_events(lin.problem.constraints)
        return cls(mean, factor, limits_within(events, mean, REACH * factor), length_m, is_whole)

    @classmethod
    def of_events(
        cls,
        lin: Linearisation,
        length_m: float,
        together: Mapping[str, Sequence[str]] | None = None,
    ) -> dict[str, Law]:
        """Laws with the limits of each joint constraint alone, where some are within reach.

        Args:
            lin: an iterate.
            length_m: of the unit of length.
            together: further names, of some constraints together.
        """
        whole = cls.of(lin, length_m)
        events = joint_events(lin.problem.constraints)
        names = {e.name: (e.name,) for e in events} | dict(together or {})
        laws = {}
        for name, those in names.items():
            own = tuple(event for event in events if event.name in those)
            limits = limits_within(own, whole.mean, REACH * whole.factor)
            if limits.inner or limits.outer:
                laws[name] = replace(whole, limits=limits)
        return laws

    @cached_property
    def span(self) -> slice:
        """Nodes within `REACH` sigma of a limit, and their neighbours; the first if there are none."""
        nodes = self.limits.nodes
        return slice(max(0, int(nodes.min()) - 1), int(nodes.max()) + 2) if len(nodes) else slice(1)

    @property
    def sources(self) -> int:
        """Number of standard normal numbers that a flight draws."""
        return self.factor.shape[2]

    def margins(self, draws: Array) -> Array:
        """Distance to the nearest limit at each node of the span, m, (nodes, m), at most `FAR`.

        Negative where the limit is broken; of draws (m, sources).
        """

        def positions(nodes: Indices) -> Array:
            factor = self.factor[nodes, :3].swapaxes(0, 1)  # components first: one matrix product
            moved = factor.reshape(-1, self.sources) @ draws.T
            at = self.mean[nodes].T[:, :, None] + moved.reshape(3, len(nodes), -1)
            return np.moveaxis(at, 0, -1)

        return self._least(positions, draws)

    def margins_at(self, positions: Array, draws: Array) -> Array:
        """As `margins`, for draws with positions at all nodes, m, shape (n, flights, 3)."""
        return self._least(lambda nodes: positions[nodes] / self.length_m, draws)

    @property
    def _signed_limits(self) -> list[tuple[float, Limit]]:
        """Limits with the sign of the margin inside their region."""
        inner, outer = self.limits
        return [*((1.0, limit) for limit in inner), *((-1.0, limit) for limit in outer)]

    def _least(self, positions: Callable[[Indices], Array], draws: Array) -> Array:
        least = np.full((len(self.mean[self.span]), len(draws)), FAR)
        parameters = draws @ self.factor[0, 3:].T
        for sign, limit in self._signed_limits:
            rows, point = limit.nodes - self.span.start, positions(limit.nodes)
            if limit.motion is not None:
                point = limit.motion.of_draws(point, parameters)
            margin = sign * self.length_m * limit.region.inside(point)
            least[rows] = np.minimum(least[rows], margin)
        return least.min(axis=0, keepdims=True) if self.is_whole else least


def drawn_factor(lin: Linearisation) -> Array:
    """Columns of the factor for the flights' random numbers, in order, (n_nodes, 6 + p, sources)."""
    problem, factor = lin.problem, lin.spread.factor
    if problem.feedback is None:
        return factor
    drawn = [factor[..., : problem.shared_columns.stop]]
    drawn += [factor[..., problem.columns_of_burn(burn)] for burn in range(problem.n_burns)]
    for j, measurement in enumerate(problem.feedback.measurement):
        # Flights draw with the triangular root of the measurement's covariance.
        turned = np.linalg.solve(np.linalg.cholesky(measurement @ measurement.T), measurement)
        drawn.append(factor[..., problem.columns_of_correction(j)[1]] @ turned.T)
    return np.concatenate(drawn, axis=2)
