"""What a subproblem asks of its state constraints: margins, and cones in the burns."""

from __future__ import annotations

from typing import Literal, NamedTuple, Protocol

import numpy as np

from formulations.linearisation.condensation import Sensitivity
from formulations.linearisation.linearisation import Linearisation
from formulations.problem.flyby import FlybyProblem, Nodes
from formulations.problem.regions import Array

Unit = Literal["length", "sigma"]
"""Units of length, or standard deviations on the normal quantile scale."""

NEAR_LENGTH = 0.002
"""Room in units of length that counts as near."""


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

    def at(self, burns: Array) -> Array:
        """The y of burns (m, 3), shape (n, d)."""
        return self.values @ burns.ravel()[: self.values.shape[2]] + self.constants


class Pulled(NamedTuple):
    """How weighed violations change with the positions of a flight.

    Attributes:
        by_mean: by the mean positions, shape (n_nodes, 3).
        by_factor: by the covariance factor's first rows, 3 of positions or all 6, and columns,
            shape (n_nodes, 3 or 6, c).
    """

    by_mean: Array
    by_factor: Array


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

    @property
    def near(self) -> float:
        """Room up to which a row had better take part in the program from the start."""
        ...

    @property
    def unit(self) -> Unit:
        """What margins count."""
        ...

    @property
    def resolution(self) -> float:
        """Relative reduction of the merit that is not told from the rows' own errors."""
        ...

    def margins(self, lin: Linearisation) -> dict[str, Margins]:
        """Margins by constraint name from the nonlinear mean and factor, never from the model."""
        ...

    def cones(self, lin: Linearisation, s: Sensitivity) -> list[Cones]:
        """The rows, convexified at an iterate, for mean and factor at `nodes` affine in the burns."""
        ...

    def pulled(self, lin: Linearisation, prices: Array) -> Pulled:
        """Derivative of the rows' violations at an iterate, each times its price; as `cones` has them.

        Args:
            lin: where.
            prices: shape (rows,).
        """
        ...


def burn_components_before(problem: FlybyProblem, nodes: Nodes) -> Nodes:
    """How many burn components the positions at some nodes depend on: those of the burns before.

    At least a burn's, so that no cone is without them.
    """
    return 3 * np.maximum(np.searchsorted(problem.burn_nodes, nodes), 1)
