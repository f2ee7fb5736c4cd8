"""The motion between burns, as the problem needs it: end states of arcs and their derivatives.

Whatever moves a spacecraft, forces that depend on velocity and on time included, is a `Flow`: the
asteroid's in closed form (`scp_recon.physics.flow`), others from an expression.
"""

from __future__ import annotations

from typing import Protocol, Self

from formulations.arrays import Array


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
        """Derivatives of all arcs, from their starts (n, 6)."""
