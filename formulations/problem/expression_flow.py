"""Make a flow from an acceleration that is written once, over CasADi's symbols.

    def acceleration(r, v, t, p):  # of position, velocity, time, parameters; three components
        return [2.0 * v[1] + 3.0 * r[0], -2.0 * v[0], -r[2]]

    flow = ExpressionFlow(acceleration, times)

CasADi differentiates the expression. This module evaluates the classical Runge-Kutta scheme and its
exact derivatives over all arcs at once. NumPy runs each operation of the expression over all
columns. CasADi's virtual machine would take the columns one by one (six times as long for 150 arcs
of the restricted three-body problem).
"""

from __future__ import annotations

from collections.abc import Callable
from copy import copy
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt
from scipy.special import erf

from formulations.arrays import Array

Acceleration = Callable[[Any, Any, Any, Any], Any]
"""Three components, of position (3,), velocity (3,), time and parameters (q,), CasADi's symbols."""

WEIGHTS = (1.0, 2.0, 2.0, 1.0)
"""Weights of the stages in a step, in sixths; and the shares of a step from each stage to the next."""
SHARES = (0.0, 0.5, 0.5, 1.0)

NUMPY: dict[str, Callable[..., Any]] = {
    "ASSIGN": lambda x: x,
    **{name: getattr(np, name.lower()) for name in ("EXP", "LOG", "SQRT", "SIN", "COS", "TAN")},
    **{name: getattr(np, name.lower()) for name in ("SINH", "COSH", "TANH", "FLOOR", "CEIL")},
    **{name: getattr(np, name.lower()) for name in ("SIGN", "FMIN", "FMAX", "COPYSIGN", "FABS")},
    **{name: getattr(np, name.lower()) for name in ("EXPM1", "LOG1P", "HYPOT", "FMOD")},
    **{f"A{name}": getattr(np, f"arc{name.lower()}") for name in ("SIN", "COS", "TAN", "TAN2")},
    **{f"A{name}": getattr(np, f"arc{name.lower()}") for name in ("SINH", "COSH", "TANH")},
    "ADD": np.add,
    "SUB": np.subtract,
    "MUL": np.multiply,
    "DIV": np.divide,
    "NEG": np.negative,
    "POW": np.power,
    "CONSTPOW": np.power,
    "SQ": np.square,
    "INV": np.reciprocal,
    "ERF": erf,
    "TWICE": lambda x: x + x,
    "IF_ELSE_ZERO": lambda c, x: np.where(c, x, 0.0),
    "LT": np.less,
    "LE": np.less_equal,
    "EQ": np.equal,
    "NE": np.not_equal,
    "NOT": np.logical_not,
    "AND": np.logical_and,
    "OR": np.logical_or,
}
"""NumPy's functions by the names of CasADi's operations."""


class Columns:
    """A CasADi function of scalars, evaluated over columns of numbers.

    Raises:
        ValueError: if it has an operation that NumPy lacks.
    """

    def __init__(self, function: Any) -> None:
        import casadi as ca

        names = {getattr(ca, f"OP_{name}"): name for name in NUMPY}
        self._outputs = [function.nnz_out(k) for k in range(function.n_out())]
        self._work = function.sz_w()
        self._steps: list[tuple[Any, tuple[int, ...], tuple[Any, ...]]] = []
        for k in range(function.n_instructions()):
            code, into = function.instruction_id(k), tuple(function.instruction_output(k))
            inputs = tuple(function.instruction_input(k))
            if code == ca.OP_CONST:
                self._steps.append(("const", into, (function.instruction_constant(k),)))
            elif code in (ca.OP_INPUT, ca.OP_OUTPUT):
                self._steps.append(("in" if code == ca.OP_INPUT else "out", into, inputs))
            elif code in names:
                self._steps.append((NUMPY[names[code]], into, inputs))
            else:
                raise ValueError(
                    f"the expression has an operation, CasADi's {code}, without NumPy's"
                )

    def __call__(self, *columns: Any) -> list[Array]:
        """Outputs of shapes (its numbers, ...), of inputs of such shapes, which may broadcast."""
        work: list[Any] = [None] * max(self._work, 1)
        shape = np.broadcast_shapes(*(np.shape(row) for part in columns for row in part))
        outputs = [np.zeros((rows, *shape)) for rows in self._outputs]
        for what, into, inputs in self._steps:
            if what == "in":
                work[into[0]] = columns[inputs[0]][inputs[1]]
            elif what == "out":
                outputs[into[0]][into[1]] = work[inputs[0]]
            elif what == "const":
                work[into[0]] = inputs[0]
            else:
                work[into[0]] = what(*(work[i] for i in inputs))
        return outputs


class _Step(NamedTuple):
    """Stages of one step: its lengths (n,), states (6, 4, n), times (4, n), gradients, derivatives."""

    h: Array
    state: Array
    time: Array
    gradient: Array  # (4, n, 3, 6)
    first: Array  # (4, n, 6, 6 + q)


@dataclass(frozen=True, eq=False)
class ExpressionDerivatives:
    """End states and derivatives of arcs: see `formulations.problem.flow.ArcDerivatives`.

    Attributes:
        state: end states, shape (n, 6).
        stm: state-transition matrices, shape (n, 6, 6).
        by_parameters: derivatives of the end states by the parameters, shape (n, 6, q).
    """

    state: Array
    stm: Array
    by_parameters: Array
    _steps: tuple[_Step, ...] = field(repr=False)
    _flow: ExpressionFlow = field(repr=False)

    @property
    def tensor(self) -> Array:
        """Second derivatives d2F_i/dx_j dx_k, shape (n, 6, 6, 6)."""
        return self._bent[:, :, :6]

    @property
    def mixed(self) -> Array:
        """Second derivatives d2F_i/dp_j dx_k, shape (n, 6, q, 6)."""
        return self._bent[:, :, 6:]

    @cached_property
    def _bent(self) -> Array:
        """Derivatives of all first ones by the arcs' starts, shape (n, 6, 6 + q, 6)."""
        n, size = len(self.state), 6 + self.by_parameters.shape[2]
        bent = np.zeros((n, 6, 6 * size))
        for h, state, time, gradient, first in self._steps:
            curvature = self._flow.curvature(state, time)
            moved = np.zeros((*first.shape[:2], size, size))
            moved[..., :6, :], moved[..., 6:, 6:] = first, np.eye(size - 6)
            bend = moved.swapaxes(-1, -2)[:, :, None] @ curvature @ first[:, :, None, :, :6]
            begun, end, slope = bent, bent, np.zeros_like(bent)
            for i, (share, weight) in enumerate(zip(SHARES, WEIGHTS, strict=True)):
                at = begun + share * h[:, None, None] * slope
                slope = np.empty_like(bent)
                slope[:, :3] = at[:, 3:]
                slope[:, 3:] = gradient[i] @ at + bend[i].reshape(n, 3, 6 * size)
                end = end + (weight / 6.0) * h[:, None, None] * slope
            bent = end
        return bent.reshape(n, 6, size, 6)

    def moved(self, deviation: Array) -> ExpressionDerivatives:
        """The same with starts moved by deviations (n, 6) so small that first order gives the ends."""
        return replace(self, state=self.state + (self.stm @ deviation[:, :, None])[:, :, 0])


class ExpressionFlow:
    """The `Flow` of an acceleration along the arcs between times, in any consistent units.

    Examples:
        >>> flow = ExpressionFlow(lambda r, v, t, p: -r, [0.0, np.pi], substeps=100)
        >>> flow.propagate(np.array([1.0, 0.0, 0.0, 0.0, 0.0, 0.0]), 0)[0].round(6).item()
        -1.0

    Args:
        acceleration: of r (3,), v (3,), t and p (q,), over CasADi's symbols: three components.
        times: of the nodes, shape (n + 1,).
        parameters: values of p, shape (q,).
        substeps: Runge-Kutta steps of fourth order along each arc.

    Raises:
        ValueError: if the acceleration has not three components, or times and substeps make no grid.
    """

    def __init__(
        self,
        acceleration: Acceleration,
        times: npt.ArrayLike,
        *,
        parameters: npt.ArrayLike = (),
        substeps: int = 1,
    ) -> None:
        import casadi as ca  # which takes half a second: only who writes an expression waits for it

        self.times, self.parameters = np.asarray(times, float), np.asarray(parameters, float)
        ascending = self.times.ndim == 1 and len(self.times) > 1 and np.all(np.diff(self.times) > 0)
        if not ascending or substeps < 1 or substeps != int(substeps):
            raise ValueError(
                "expected two ascending times or more and a whole number of steps an arc, "
                f"not {self.times}, {substeps}"
            )
        self.substeps = int(substeps)
        y, t, p = ca.SX.sym("y", 6), ca.SX.sym("t"), ca.SX.sym("p", len(self.parameters))
        found = acceleration(y[:3], y[3:], t, p)
        rate = ca.vertcat(*found) if isinstance(found, (list, tuple)) else ca.SX(found)
        if rate.shape != (3, 1):
            raise ValueError(f"expected an acceleration of shape (3, 1), found {rate.shape}")
        by_state = ca.jacobian(rate, y)
        both = ca.horzcat(by_state, ca.jacobian(rate, p))

        def columns(*outputs: Any) -> Columns:
            dense = [ca.densify(ca.vec(output.T)) for output in outputs]
            return Columns(ca.Function("f", [y, t, p], dense, {"cse": True}))

        self._rate, self._gradient = columns(rate), columns(both)
        self._curvature = columns(ca.jacobian(ca.vec(both.T), y))

    @property
    def arcs(self) -> int:
        """Number of arcs."""
        return len(self.times) - 1

    def propagate(self, state: Array, arc: int) -> Array:
        """Carry states (..., 6) along one arc."""
        y = np.moveaxis(np.asarray(state, dtype=float), -1, 0)
        h = (self.times[arc + 1] - self.times[arc]) / self.substeps
        for k in range(self.substeps):
            _, _, y = self._step(y, self.times[arc] + k * h, h)
        return np.moveaxis(y, 0, -1)

    def differentiate(self, state: Array) -> ExpressionDerivatives:
        """Derivatives of all arcs, from their starts (n, 6)."""
        y, q = np.asarray(state, dtype=float).T, len(self.parameters)
        h = np.diff(self.times) / self.substeps
        first = np.broadcast_to(np.eye(6, 6 + q), (self.arcs, 6, 6 + q))
        steps = []
        for k in range(self.substeps):
            states, times, y = self._step(y, self.times[:-1] + k * h, h)
            gradient = self._gradient(states, [times], self.parameters)[0]
            gradient = np.moveaxis(gradient.reshape(3, 6 + q, 4, -1), (0, 1), (2, 3))
            own, end, slope = [], first, np.zeros_like(first)
            for i, (share, weight) in enumerate(zip(SHARES, WEIGHTS, strict=True)):
                own.append(first + share * h[:, None, None] * slope)
                slope = np.empty_like(end)
                slope[:, :3] = own[-1][:, 3:]
                slope[:, 3:] = gradient[i, :, :, :6] @ own[-1]
                slope[:, 3:, 6:] += gradient[i, :, :, 6:]
                end = end + (weight / 6.0) * h[:, None, None] * slope
            steps.append(_Step(h, states, times, gradient[..., :6], np.stack(own)))
            first = end
        parts = y.T.copy(), first[..., :6], first[..., 6:]
        return ExpressionDerivatives(*parts, tuple(steps), self)

    def with_parameters(self, values: Array) -> ExpressionFlow:
        """The flow of other parameters: numbers (q,), or one a flight (q, flights) to propagate."""
        other = copy(self)
        other.parameters = values
        return other

    def curvature(self, state: Array, time: Array) -> Array:
        """Derivatives of the acceleration's by state and parameters, by the state (6, 4, n).

        Shape (4, n, 3, 6 + q, 6).
        """
        found = self._curvature(state, [time], self.parameters)[0]
        rows = 6 + len(self.parameters)
        return np.moveaxis(found.reshape(3, rows, 6, 4, -1), (0, 1, 2), (2, 3, 4))

    def _step(self, y: Array, t: Any, h: Any) -> tuple[Array, Array, Array]:
        """States (6, 4, ...) and times (4, ...) of a step's stages, and its end (6, ...), from y."""
        times = np.stack([t + share * h for share in SHARES])
        states, rate, end = [], np.zeros_like(y), y
        for share, weight, time in zip(SHARES, WEIGHTS, times, strict=True):
            states.append(y + (share * h) * rate)
            acceleration = self._rate(states[-1], [time], self.parameters)[0]
            rate = np.concatenate([states[-1][3:], acceleration])
            end = end + (weight / 6.0 * h) * rate
        return np.stack(states, axis=1), times, end
