"""Interface of the motion between burns: end states of arcs and their derivatives.

A `Flow` may have any forces, also ones that depend on velocity and time. The flow about an asteroid
has derivatives in closed form (`scp_recon.physics.flow`). Others are made from an expression
(`expression_flow`).
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Protocol, Self, cast, runtime_checkable

import numpy as np

from formulations.arrays import Array, Indices


class ArcDerivatives(Protocol):
    """End states, STMs and second-order tensors of n arcs, each from a start of its own."""

    @property
    def state(self) -> Array:
        """End states F_k(x), shape (n, 6)."""

    @property
    def stm(self) -> Array:
        """State-transition matrices dF_i/dx_j of every arc k, shape (n, 6, 6)."""

    @property
    def tensor(self) -> Array:
        """Second derivatives d2F_i/dx_j dx_l of every arc k, (n, 6, 6, 6); of P2 alone, so be lazy."""

    def moved(self, deviation: Array) -> Self:
        """The same with starts moved by (n, 6), so little that first order gives the ends."""


class Flow(Protocol):
    """The motion without burns along the n arcs of a grid; an arc has a start time and a duration."""

    @property
    def arcs(self) -> int:
        """Number of arcs n."""

    def propagate(self, state: Array, arc: int) -> Array:
        """Carry states (..., 6) along one arc."""

    def differentiate(self, state: Array) -> ArcDerivatives:
        """Derivatives of the first n arcs, from their starts (n, 6); only drifts leave arcs out."""


class UncertainDerivatives(ArcDerivatives, Protocol):
    """Derivatives of a flow with p uncertain parameters, constants of standard normal law."""

    @property
    def by_parameters(self) -> Array:
        """Derivatives dF_i/dw_j of the ends by the parameters, shape (n, 6, p)."""

    @property
    def mixed(self) -> Array:
        """Second derivatives d2F_i/dw_j dx_l, shape (n, 6, p, 6)."""


def by_parameters(arcs: ArcDerivatives, parameters: int) -> Array:
    """Derivatives of arcs' ends by a number of parameters, shape (n, 6, parameters)."""
    if not parameters:
        return np.zeros((len(arcs.state), 6, 0))
    return cast("UncertainDerivatives", arcs).by_parameters


def bending(arcs: ArcDerivatives, parameters: int) -> Array:
    """Derivatives by the state of the STM and of `by_parameters`, shape (n, 6, 6 + parameters, 6)."""
    if not parameters:
        return arcs.tensor
    return np.concatenate([arcs.tensor, cast("UncertainDerivatives", arcs).mixed], axis=2)


class MovableDerivatives(ArcDerivatives, Protocol):
    """Derivatives of a `MovableFlow`."""

    def rate(self, state: Array, arcs: Indices) -> tuple[Array, Array]:
        """Rate f of states (n, 6) at the starts of some arcs, and its derivatives, shape (n, 6, 6 + p).

        By the state and by the p uncertain parameters, if the flow has some. The number after the last
        arc's stands for its end.
        """


@runtime_checkable
class MovableFlow(Flow, Protocol):
    """A flow whose nodes can be moved in time: what free firing times need."""

    def at(self, times: Array) -> MovableFlow:
        """The flow along as many arcs between other times of the nodes, shape (n + 1,)."""

    def differentiate(self, state: Array) -> MovableDerivatives:
        """Derivatives of all arcs, from their starts (n, 6)."""


@dataclass(frozen=True, eq=False)
class ScaledFlow:
    """A flow in other units, of the state's components, shape (6,)."""

    flow: Flow
    unit: Array

    @property
    def arcs(self) -> int:
        """Number of arcs."""
        return self.flow.arcs

    def propagate(self, state: Array, arc: int) -> Array:
        """Carry states (..., 6) along one arc."""
        return self.flow.propagate(state * self.unit, arc) / self.unit

    def differentiate(self, state: Array) -> ScaledDerivatives:
        """Derivatives of all arcs, from their starts (n, 6)."""
        return ScaledDerivatives(self.flow.differentiate(state * self.unit), self.unit)


@dataclass(frozen=True, eq=False)
class ScaledDerivatives:
    """Derivatives of a `ScaledFlow`."""

    arcs: ArcDerivatives
    unit: Array

    @property
    def state(self) -> Array:
        """End states, shape (n, 6)."""
        return self.arcs.state / self.unit

    @cached_property
    def stm(self) -> Array:
        """State-transition matrices, shape (n, 6, 6)."""
        return self.arcs.stm * self.unit / self.unit[:, None]

    @cached_property
    def tensor(self) -> Array:
        """Second derivatives, shape (n, 6, 6, 6)."""
        unit = self.unit
        return self.arcs.tensor * unit * unit[:, None] / unit[:, None, None]

    @property
    def by_parameters(self) -> Array:
        """See `UncertainDerivatives`."""
        return cast("UncertainDerivatives", self.arcs).by_parameters / self.unit[:, None]

    @property
    def mixed(self) -> Array:
        """See `UncertainDerivatives`."""
        mixed = cast("UncertainDerivatives", self.arcs).mixed
        return mixed * self.unit / self.unit[:, None, None]

    def moved(self, deviation: Array) -> ScaledDerivatives:
        """See `ArcDerivatives.moved`."""
        return ScaledDerivatives(self.arcs.moved(deviation * self.unit), self.unit)


def check_flow(flow: Flow, unit: Array, state: Array) -> None:
    """Check a flow's shapes, and its derivatives by central differences of its own map.

    The checks use starts (n, 6) of the arcs, nondimensional by the units of a state's components.

    Raises:
        ValueError: if a shape or a derivative is wrong; the message has the value found and the one
            expected.
    """
    n = flow.arcs
    own = flow.differentiate(state * unit)
    shapes = {"state": (n, 6), "stm": (n, 6, 6), "tensor": (n, 6, 6, 6)}
    for name, shape in shapes.items():
        if np.shape(found := getattr(own, name)) != shape:
            raise ValueError(f"{name} of shape {np.shape(found)}, expected {shape} of {n} arcs")
    flow, at = ScaledFlow(flow, unit), ScaledDerivatives(own, unit)
    ends = np.stack([flow.propagate(state[k], k) for k in (0, n - 1)])
    way = np.random.default_rng(0).choice([-1.0, 1.0], size=(n, 6))
    ahead, behind = (flow.differentiate(state + side * DIFFERENCE * way) for side in (1, -1))
    slope, bend = ((getattr(ahead, k) - getattr(behind, k)) / 2 for k in ("state", "stm"))
    along = at.tensor @ way[:, None, :, None]
    for name, one, other in (
        ("end states that are not where `propagate` ends", at.state[[0, -1]], ends),
        ("an STM that is not its map's derivative", at.stm @ way[:, :, None], slope / DIFFERENCE),
        ("a tensor that is not its STM's derivative", along[..., 0], bend / DIFFERENCE),
    ):
        other = other.reshape(one.shape)
        if not np.abs(one - other).max() <= AGREED * max(1.0, float(np.abs(other).max())):
            raise ValueError(f"{name}, by {np.abs(one - other).max():.1e} in units of the problem")


DIFFERENCE, AGREED = 1e-5, 1e-3
"""Step of the differences, and the share of the largest entry to which they have to agree."""
