"""Compute probabilities of breaking limits over CasADi's symbols, as `risk.quadratic_forms` does.

NumPy chooses new contours at each point. The integral does not depend on the contour (Cauchy's
theorem). The first and second derivatives of the probability are therefore CasADi's derivatives of
the integrand along fixed contours.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from typing import Any, NamedTuple

import casadi as ca
import numpy as np

from formulations.arrays import Array
from formulations.risk import quadratic_forms as forms

NONE = -700.0
"""Logarithm of a probability that counts as none."""


class Limits(NamedTuple):
    """Limits x'Mx <= l on normal vectors, n of them.

    Attributes:
        matrix: M, symmetric, shape (n, 3, 3).
        level: l, shape (n,).
        side: 1 if the limit is broken where x'Mx > l, -1 if it is where x'Mx < l.
        rule: `WHOLE` or, close to where x'Mx = l comes to a point, `NAPPE`.
    """

    matrix: Array
    level: Array
    side: float
    rule: forms.Rule


def broken(limits: Limits, mean: ca.MX, covariance: ca.MX) -> tuple[ca.MX, ca.Callback]:
    """Probabilities that limits are broken, shape (1, n), and the object that evaluates them.

    The object must live as long as the probabilities are in use.

    Args:
        limits: n of them.
        mean: of the vectors, shape (3, n).
        covariance: theirs column by column, positive definite, shape (9, n).
    """
    n, points = len(limits.level), limits.rule.points
    contours, given = _Contours(limits), (ca.MX.sym("d", 3, n), ca.MX.sym("C", 9, n))
    laid = contours(*given)
    peak, path = laid[0, :], ca.reshape(laid[1:, :], 4, points * n)
    numbers = ca.DM(np.vstack([limits.matrix.reshape(n, 9).T, limits.level]))
    form = _form().map(n)(*given, numbers)
    each = np.repeat(np.arange(n), points).tolist()
    parts = _integrand().map(points * n)(form[:, each], peak[:, each], path)
    total = limits.side * ca.sum1(ca.reshape(parts, points, n))
    # As a function of its own it is differentiated by 12 numbers a limit, not by all unknowns.
    own = ca.Function("broken", list(given), [ca.exp(peak) * total], {"jac_penalty": 0.0})
    return own(mean, covariance), contours


@cache
def _form() -> ca.Function:
    """Function from mean, covariance L L' and (M, l) to L'ML, lower triangle, L'Md, and d'Md - l."""
    mean, covariance, given = ca.SX.sym("d", 3), ca.SX.sym("C", 9), ca.SX.sym("given", 10)
    root, matrix = ca.chol(ca.reshape(covariance, 3, 3)).T, ca.reshape(given[:9], 3, 3)
    bent, pull = root.T @ matrix @ root, matrix @ mean
    lower = [bent[i, j] for i in range(3) for j in range(i + 1)]
    value = ca.dot(mean, pull) - given[9]
    return ca.Function(
        "form", [mean, covariance, given], [ca.vertcat(*lower, root.T @ pull, value)]
    )


@cache
def _integrand() -> ca.Function:
    """Imaginary part of exp(log G - peak) dt/t / pi at a point of the contour.

    The pivots of I - 2 t L'ML have positive real parts, as the matrix's real part is positive definite:
    the root of its determinant is the product of their principal ones.
    """
    form, peak, point = ca.SX.sym("form", 10), ca.SX.sym("peak"), ca.SX.sym("point", 4)
    t, weight = _Complex(point[0], point[1]), _Complex(point[2], point[3])
    a11, a21, a22, a31, a32, a33 = (
        t.times(-2.0 * form[k]).plus(diagonal) for k, diagonal in enumerate((1, 0, 1, 0, 0, 1))
    )
    b1, b2, b3 = (_Complex(form[6 + k], ca.SX(0.0)) for k in range(3))
    l21, l31 = a21 / a11, a31 / a11
    p2, b2, c32 = a22 - l21 * a21, b2 - l21 * b1, a32 - l31 * a21
    l32 = c32 / p2
    p3, b3 = a33 - l31 * a31 - l32 * c32, b3 - l31 * b1 - l32 * b2
    solved = (-(b1 * b1 / a11) - b2 * b2 / p2) - b3 * b3 / p3
    log = t.times(form[9]) - (t * t * solved).times(2.0)
    for pivot in (a11, p2, p3):
        log = log - pivot.log().times(0.5)
    size = ca.exp(log.re - peak)
    turned = weight * _Complex(size * ca.cos(log.im), size * ca.sin(log.im))
    return ca.Function("integrand", [form, peak, point], [turned.im])


@dataclass(frozen=True)
class _Complex:
    """A complex number over symbols, which CasADi has none of."""

    re: ca.SX
    im: ca.SX

    def __neg__(self) -> _Complex:
        return _Complex(-self.re, -self.im)

    def __sub__(self, other: _Complex) -> _Complex:
        return _Complex(self.re - other.re, self.im - other.im)

    def __mul__(self, other: _Complex) -> _Complex:
        a, b, c, d = self.re, self.im, other.re, other.im
        return _Complex(a * c - b * d, a * d + b * c)

    def __truediv__(self, other: _Complex) -> _Complex:
        size = other.re**2 + other.im**2
        return self * _Complex(other.re / size, -other.im / size)

    def times(self, number: ca.SX | float) -> _Complex:
        """Product with a real number."""
        return _Complex(number * self.re, number * self.im)

    def plus(self, number: float) -> _Complex:
        """Sum with a real number."""
        return _Complex(self.re + number, self.im)

    def log(self) -> _Complex:
        """Principal value."""
        return _Complex(0.5 * ca.log(self.re**2 + self.im**2), ca.atan2(self.im, self.re))


class _Contours(ca.Callback):
    """Columns (peak, then real and imaginary parts of t and of the weight at each point).

    Its Jacobian is zero: the integral does not feel where the contour is.
    """

    def __init__(self, limits: Limits) -> None:
        ca.Callback.__init__(self)
        self._limits = limits
        self.construct("contours", {})

    def get_n_in(self) -> int:
        """Mean and covariance."""
        return 2

    def get_sparsity_in(self, i: int) -> ca.Sparsity:
        """See `broken`."""
        return ca.Sparsity.dense((3, 9)[i], len(self._limits.level))

    def get_sparsity_out(self, i: int) -> ca.Sparsity:  # noqa: ARG002 -- of the protocol
        """One column each."""
        return ca.Sparsity.dense(1 + 4 * self._limits.rule.points, len(self._limits.level))

    def eval(self, arguments: Sequence[ca.DM]) -> list[Array]:
        """See `casadi.Callback`."""
        matrix, level, side, rule = self._limits
        mean, covariance = (np.array(one).T for one in arguments)
        form = forms._form(matrix, mean, level, covariance.reshape(-1, 3, 3))
        t, weight = forms._descent(form, np.full(len(mean), side), rule)
        x = 1.0 - 2.0 * t[:, :, None] * form.eigenvalue[:, None]
        log = forms._exponent(form, t, x) - 0.5 * np.log(x).sum(axis=2)
        peak = np.maximum(log[:, 0].real, NONE)
        seen = (peak > NONE)[:, None]
        size = weight * np.exp(np.where(seen, log - peak[:, None], 0.0))
        kept = seen & (
            forms._ended(size) != 0.0
        )  # beyond its end a contour stays at the first point
        t, weight = np.where(kept, t, t[:, :1]), np.where(kept, weight, 0.0)
        path = np.stack([t.real, t.imag, weight.real, weight.imag], axis=2)
        return [np.column_stack([peak, path.reshape(len(peak), -1)]).T]

    def has_jac_sparsity(self, oind: int, iind: int) -> bool:  # noqa: ARG002 -- of the protocol
        """It is known."""
        return True

    # Of the protocol of CasADi's callbacks, unused arguments included.
    def get_jac_sparsity(self, oind: int, iind: int, symmetric: bool) -> ca.Sparsity:  # noqa: ARG002
        """None."""
        return ca.Sparsity(self.sparsity_out(0).numel(), self.sparsity_in(iind).numel())

    def has_jacobian(self) -> bool:
        """It has one."""
        return True

    def get_jacobian(
        self, name: str, inputs: Sequence[str], outputs: Sequence[str], options: Mapping[str, Any]
    ) -> ca.Function:
        """See `casadi.Callback`."""
        shapes = [self.sparsity_in(0), self.sparsity_in(1), self.sparsity_out(0)]
        given = [ca.MX.sym(one, shape) for one, shape in zip(inputs, shapes, strict=True)]
        none = [ca.MX(shapes[2].numel(), shape.numel()) for shape in shapes[:2]]
        return ca.Function(name, given, none, list(inputs), list(outputs), dict(options))
