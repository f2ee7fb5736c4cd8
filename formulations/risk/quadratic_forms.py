"""Probability that a quadratic form of a normal vector is negative, by one integral along a contour.

Balls and circular cones are sets Q(x) = x'Mx - l <= 0. For x normal with mean d and covariance C the
transform G(t) = E[exp(t Q)] has a closed form, and with a contour that crosses the real axis at t0

    1/(2 pi i) int G(t)/t dt = P(Q > 0) for t0 > 0,  -P(Q < 0) for t0 < 0.

The contour crosses it at the saddle point of G(t)/t, where the integrand is largest, and follows its
descent: the trapezoidal rule converges geometrically, however slender the law is (Rice, SIAM
J. Sci. Stat. Comput. 1 (1980) 438; Weideman and Trefethen, Math. Comp. 76 (2007) 1341). With the tilted
law's mean x(t) = (I - 2 t C M)^-1 d the derivatives are

    dG/dd = G p,  p = 2 t M x(t),  dG/dC = d2G/dd2 / 2 = G (t M (I - 2 t C M)^-1 + p p'/2).

A cone's equation holds on both nappes. On one of them, a'x > 0, the transform is G times the normal
distribution function of a'x(t) over its standard deviation under the tilted law.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import numpy.typing as npt
from scipy.special import wofz

from formulations.arrays import Array

ComplexArray = npt.NDArray[np.complex128]


class Rule(NamedTuple):
    """Trapezoidal rule on one half of a contour, the other being its mirror image.

    The step is that of the parameter x, where the contour is about t0 + i A sinh x.
    """

    step: float
    points: int


WHOLE, NAPPE = Rule(0.15, 48), Rule(0.05, 320)
"""For errors below 1e-7 at laws 30 times as long as thick; below 1e-6 within six deviations of a cone's
apex, where the integrand falls slowly."""

LEAN_MIN, LEAN_MAX = 0.3, 1.0
"""Least and greatest slope of a contour's bend, real over imaginary part."""

UPRIGHT = 0.5
"""Largest bend of a contour over the distance from the saddle point to the singularity beyond."""

NEGLIGIBLE = 1e-11
"""Value, relative to the saddle point's, below which the integrand is negligible: the contour ends."""

NEWTON, CLOSE = 40, 1e-2
"""Most steps to a saddle point, and the relative change that is near enough: any point does."""


class Below(NamedTuple):
    """Probabilities of Q < 0 and Q > 0, and the gradient of the first.

    Attributes:
        below: P(Q < 0), shape (n,).
        above: P(Q > 0); the smaller of the two is accurate to a relative error.
        by_mean: d below / dd, shape (n, 3).
        by_covariance: d below / dC, symmetric, shape (n, 3, 3).
    """

    below: Array
    above: Array
    by_mean: Array
    by_covariance: Array


class _Form(NamedTuple):
    """A form in the principal axes of L'ML, where C = LL'.

    With W = LU, L'ML = U diag(eigenvalue) U', Q is value + 2 slope'y + y'diag(eigenvalue)y for a
    standard normal y.

    Attributes:
        matrix: M, shape (n, 3, 3).
        gradient: Md, shape (n, 3).
        axes: W, shape (n, 3, 3).
        spread: MW, shape (n, 3, 3).
        value: Q(d), shape (n,).
        slope: W'Md, shape (n, 3).
        eigenvalue: ascending, shape (n, 3).
    """

    matrix: Array
    gradient: Array
    axes: Array
    spread: Array
    value: Array
    slope: Array
    eigenvalue: Array

    def slopes(self, t: Array) -> tuple[Array, Array, Array]:
        """First three derivatives of log G at real t, shape (n,)."""
        t, e, b2 = t[:, None], self.eigenvalue, self.slope**2
        x = 1.0 - 2.0 * t * e
        first = self.value + np.sum(e / x + 4.0 * t * b2 * (1.0 - t * e) / x**2, axis=1)
        second = np.sum(2.0 * (e / x) ** 2 + 4.0 * b2 / x**3, axis=1)
        third = np.sum(8.0 * (e / x) ** 3 + 24.0 * b2 * e / x**4, axis=1)
        return first, second, third


def below(matrix: Array, mean: Array, level: Array, covariance: Array, rule: Rule = WHOLE) -> Below:
    """Probability of x'Mx < l for normal x.

    Args:
        matrix: M, symmetric, shape (n, 3, 3).
        mean: d, shape (n, 3).
        level: l, shape (n,).
        covariance: C, positive definite, shape (n, 3, 3).
        rule: `WHOLE` or, close to where x'Mx = l comes to a point, `NAPPE`.
    """
    form = _form(matrix, mean, level, covariance)
    side = np.where(form.value + form.eigenvalue.sum(axis=1) < 0.0, 1.0, -1.0)
    t, weight = _descent(form, side, rule)
    x = 1.0 - 2.0 * t[:, :, None] * form.eigenvalue[:, None]
    f = _ended(weight * np.exp(_exponent(form, t, x)) / np.sqrt(x).prod(axis=2))
    p = _tilted_gradient(form, t, x)
    by_covariance = _squares(f, p, p) + _curvature(form, t, x, f)
    tail, rest = side * f.imag.sum(axis=1), 1.0 - side * f.imag.sum(axis=1)
    return Below(
        np.where(side < 0.0, tail, rest),
        np.where(side < 0.0, rest, tail),
        -np.einsum("nk,nki->ni", f, p).imag,
        -0.5 * by_covariance,
    )


def below_beyond(matrix: Array, mean: Array, axis: Array, covariance: Array) -> Below:
    """Probability of x'Mx < 0 and a'x > 0 for normal x: of a cone's nappe that the mean is not on.

    Args:
        matrix: M, symmetric and positive definite across a, shape (n, 3, 3).
        mean: d with a'd <= 0, shape (n, 3).
        axis: a, shape (n, 3).
        covariance: C, positive definite, shape (n, 3, 3).
    """
    n = len(mean)
    form = _form(matrix, mean, np.zeros(n), covariance)
    t0 = _saddle_point(form, -np.ones(n))
    t, weight = _contour(form, t0, np.full(n, -LEAN_MIN), NAPPE)
    x = 1.0 - 2.0 * t[:, :, None] * form.eigenvalue[:, None]
    across = np.einsum("nij,ni->nj", form.axes, axis)
    pulled = across[:, None] / x
    sigma = np.sqrt(np.einsum("nj,nkj->nk", across, pulled))
    climb = np.einsum("ni,ni->n", axis, mean)[:, None]
    h = (climb + 2.0 * t * np.einsum("nj,nkj->nk", form.slope, pulled)) / sigma
    # G times the distribution function, and G times the density over sigma; each may be out of range.
    weight = weight / np.sqrt(x).prod(axis=2)
    exponent = _exponent(form, t, x)
    low = h.real <= 0.0
    edge = weight * np.exp(exponent - 0.5 * h * h)
    tail = 0.5 * edge * wofz(1j * np.where(low, -h, h) / np.sqrt(2.0))
    f = np.where(low, tail, weight * np.exp(np.where(low, 0.0, exponent)) - tail)
    kept = _ended(f) != 0.0
    f, edge = np.where(kept, f, 0.0), np.where(kept, edge / np.sqrt(2.0 * np.pi) / sigma, 0.0)
    p = _tilted_gradient(form, t, x)
    c = axis[:, None] + 2.0 * t[:, :, None] * np.einsum("nij,nkj->nki", form.spread, pulled)
    mixed = _squares(edge, p, c)
    by_covariance = _squares(f, p, p) + mixed + mixed.swapaxes(1, 2)
    by_covariance += _curvature(form, t, x, f) - _squares(edge * h / sigma, c, c)
    inside = -f.imag.sum(axis=1)
    by_mean = np.einsum("nk,nki->ni", f, p).imag + np.einsum("nk,nki->ni", edge, c).imag
    return Below(inside, 1.0 - inside, -by_mean, -0.5 * by_covariance)


def _form(matrix: Array, mean: Array, level: Array, covariance: Array) -> _Form:
    root = np.asarray(np.linalg.cholesky(covariance), dtype=float)
    eigenvalue, turn = np.linalg.eigh(root.swapaxes(1, 2) @ matrix @ root)
    axes = root @ turn
    gradient = np.einsum("nij,nj->ni", matrix, mean)
    value = np.einsum("ni,ni->n", mean, gradient) - level
    slope = np.einsum("nij,ni->nj", axes, gradient)
    return _Form(matrix, gradient, axes, matrix @ axes, value, slope, eigenvalue)


def _saddle_point(form: _Form, side: Array) -> Array:
    """Real t on one side of zero that nearly minimises log G(t) - log |t|, which is convex."""
    worst = np.maximum(
        side * np.where(side > 0.0, form.eigenvalue[:, -1], form.eigenvalue[:, 0]), 0.0
    )
    with np.errstate(divide="ignore"):
        end = 0.5 / worst
    first, second, _ = form.slopes(np.zeros_like(side))
    size = np.minimum(
        0.5 * end, (np.abs(first) + np.sqrt(first**2 + 4.0 * second)) / (2.0 * second)
    )
    for _ in range(NEWTON):
        first, second, _ = form.slopes(side * size)
        step = (side * first - 1.0 / size) / (second + 1.0 / size**2)
        last = np.minimum(4.0 * size, size + 0.7 * (end - size))
        size, before = np.clip(size - step, 0.2 * size, last), size
        if np.all(np.abs(size - before) < CLOSE * size):
            break
    return side * size


def _descent(form: _Form, side: Array, rule: Rule) -> tuple[ComplexArray, ComplexArray]:
    """The contour through the saddle point on a side of zero, bent as the integrand descends."""
    t0 = _saddle_point(form, side)
    _, second, third = form.slopes(t0)
    skewness = (third - 2.0 / t0**3) / (3.0 * (second + 1.0 / t0**2) ** 1.5)
    lean = np.copysign(np.clip(np.abs(skewness), LEAN_MIN, LEAN_MAX), third)
    return _contour(form, t0, lean, rule)


def _contour(form: _Form, t0: Array, lean: Array, rule: Rule) -> tuple[ComplexArray, ComplexArray]:
    """Points t of the upper half, and weights dt/t / pi, shape (n, points).

    The contour bends to the side of `lean`'s sign, and turns upright before the singularity beyond
    the saddle point.
    """
    x = rule.step * np.arange(rule.points)
    _, second, _ = form.slopes(t0)
    scale = 1.0 / np.sqrt(second + 1.0 / t0**2)[:, None]
    sign, e = np.sign(lean), form.eigenvalue
    beyond = np.maximum(np.where(sign > 0.0, -e[:, 0], e[:, -1]), 0.0)
    out = scale * np.abs(lean)[:, None] * (np.cosh(x) - 1.0)
    bend = 1.0 / (1.0 + 2.0 / UPRIGHT * beyond[:, None] * out)
    t = t0[:, None] + sign[:, None] * out * bend + 1j * scale * np.sinh(x)
    speed = lean[:, None] * np.sinh(x) * bend**2 + 1j * np.cosh(x)
    share = np.full(rule.points, rule.step / np.pi)
    share[0] *= 0.5
    return t, share * scale * speed / t


def _exponent(form: _Form, t: ComplexArray, x: ComplexArray) -> ComplexArray:
    """Log G without the determinant's part."""
    bent = np.einsum("nj,nkj->nk", form.slope**2, 1.0 / x)
    return np.asarray(t * form.value[:, None] + 2.0 * t * t * bent)


def _ended(f: ComplexArray) -> ComplexArray:
    """Integrands, set to zero from their first negligible value on."""
    size = np.abs(f)
    return np.where(np.logical_or.accumulate(size < NEGLIGIBLE * size[:, :1], axis=1), 0.0, f)


def _tilted_gradient(form: _Form, t: ComplexArray, x: ComplexArray) -> ComplexArray:
    """p, shape (n, points, 3)."""
    t = t[:, :, None]
    shift = 2.0 * t * form.slope[:, None] / x
    return np.asarray(2.0 * t * (form.gradient[:, None] + shift @ form.spread.swapaxes(1, 2)))


def _squares(weight: ComplexArray, one: ComplexArray, other: ComplexArray) -> Array:
    """Imaginary part of the sums of weighted products, shape (n, 3, 3)."""
    return np.asarray(((weight[:, :, None] * one).swapaxes(1, 2) @ other).imag)


def _curvature(form: _Form, t: ComplexArray, x: ComplexArray, f: ComplexArray) -> Array:
    """Imaginary part of the sums of f 2 t M (I - 2 t C M)^-1, shape (n, 3, 3)."""
    once = (f * t).imag.sum(axis=1)
    twice = np.einsum("nk,nkj->nj", f * t * t, 1.0 / x).imag
    spread = form.spread
    bent = (spread * twice[:, None]) @ spread.swapaxes(1, 2)
    return np.asarray(2.0 * form.matrix * once[:, None, None] + 4.0 * bent)
