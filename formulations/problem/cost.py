"""Cost of a plan: the sum of the burns' sizes; with corrected burns its mean or its 99 % quantile.

The law of the commanded sizes, sum_i |v_i + U_i xi|, depends on burns v and gains U alone. Mean and
quantile are taken over fixed quasi-random draws of xi, and are smooth functions of both. The convex
program has a formula instead: a burn has about the size

    ||(v, U)|| + s'xi,    s = U'v / ||(v, U, d)||,

whose first term bounds the mean from above (Jensen's inequality), with a small d for burns without a
direction, and the 99 % quantile is about sum_i ||(v_i, U_i)|| + 2.326 ||sum_i s_i||. It is tilted, so
that at the iterate value and gradient are those over the draws.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from scipy.special import ndtr, ndtri

from formulations.arrays import Array
from formulations.problem.flyby import FlybyProblem, Iterate
from formulations.risk.directions import normal_points
from formulations.risk.lines import normal_density

PROBABILITY = 0.99
QUANTILE = float(ndtri(PROBABILITY))
"""Standard deviations that the 99 % quantile of a normal number lies above its mean."""

SMALLEST = 1e-4
"""Price of gains where corrections cost nothing: among gains of equal worth the smallest are chosen."""

DRAWS = 8192
"""Draws of xi over which sizes are looked at, a power of two."""

SMOOTH = 0.2
"""Width of the kernel that smooths their distribution, over its standard deviation."""

DIRECTED = 1e-2
"""Over the largest burn: a smaller one has hardly a direction along which corrections add up."""

TINY = 1e-300
"""Stands for zero in a quotient."""


class Valued(NamedTuple):
    """A function of all controls.

    Attributes:
        value: at an iterate.
        gradient: by the controls, shape (controls,).
    """

    value: float
    gradient: Array


def cost(problem: FlybyProblem, iterate: Iterate) -> Valued:
    """The total delta-v that is minimised, as the problem's feedback counts it."""
    feedback = problem.feedback
    if feedback is None or feedback.cost == "nominal" or not iterate.gains.any():
        return formula(problem, iterate)
    sizes, slopes = _sizes(problem, iterate)
    mean = float(sizes.mean())
    if feedback.cost == "expected":
        return Valued(mean, slopes(np.full(DRAWS, 1.0 / DRAWS)))
    off = sizes - mean
    width = max(float(off.std()), TINY)
    # The kernel widens the distribution; narrowed beforehand it keeps its variance.
    off /= np.sqrt(1.0 + SMOOTH**2)
    quantile = _quantile(off, SMOOTH * width)
    weight = normal_density((quantile - off) / (SMOOTH * width))
    weight /= weight.sum()
    # By the sizes themselves; by their mean; by the kernel's width.
    by_size = weight / np.sqrt(1.0 + SMOOTH**2)
    by_size += (1.0 - by_size.sum()) / DRAWS
    by_width = float(weight @ (quantile - off)) / width
    by_size += by_width * (sizes - mean) / (DRAWS * width)
    return Valued(mean + quantile, slopes(by_size))


def formula(problem: FlybyProblem, iterate: Iterate) -> Valued:
    """The convex program's cost, in which the spread of the sizes is linearised, and its gradient."""
    feedback = problem.feedback
    sizes = np.linalg.norm(iterate.burns, axis=1)
    gradient = np.zeros(problem.controls_before[-1])
    gradient[problem.burn_controls] = iterate.burns / np.maximum(sizes, TINY)[:, None]
    total = float(sizes.sum())
    if feedback is None:
        return Valued(total, gradient)
    for burn in feedback.burns:
        first, stop = problem.controls_before[burn : burn + 2]
        own = problem.controls(iterate.burns, iterate.gains)[first:stop]
        spent = float(np.linalg.norm(own[3:]))
        if feedback.cost == "nominal":
            total += SMALLEST * spent
            gradient[first + 3 : stop] = SMALLEST * own[3:] / max(spent, TINY)
            continue
        size = float(np.linalg.norm(own))
        total += size - sizes[burn]
        gradient[first:stop] = own / max(size, TINY)
    if feedback.cost == "dv99":
        spread, jacobian = size_spread(problem, iterate)
        width = float(np.linalg.norm(spread))
        total += QUANTILE * width
        gradient += QUANTILE * (spread / max(width, TINY)) @ jacobian
    return Valued(total, gradient)


def size_spread(problem: FlybyProblem, iterate: Iterate) -> tuple[Array, Array]:
    """The sum of all s_i, shape (6 k,), and its derivative by the controls, shape (6 k, controls)."""
    feedback = problem.feedback
    assert feedback is not None
    k, least = len(feedback.burns), DIRECTED * problem.dv_max
    value, jacobian = np.zeros(6 * k), np.zeros((6 * k, problem.controls_before[-1]))
    for j, burn in enumerate(feedback.burns):
        v, gains, n = iterate.burns[burn], problem.gains_of(iterate, j), 6 * (j + 1)
        size = float(np.sqrt(v @ v + np.sum(gains**2) + least**2))
        along = v @ gains / size
        value[:n] += along
        first, stop = problem.controls_before[burn : burn + 2]
        jacobian[:n, first : first + 3] += gains.T / size - np.outer(along, v) / size**2
        own = np.zeros((n, 3, n))
        own[range(n), :, range(n)] = v / size
        own -= along[:, None, None] * gains / size**2
        jacobian[:n, first + 3 : stop] += own.reshape(n, -1)
    return value, jacobian


class _Slopes(NamedTuple):
    """Gradients by the controls of weighed sums of the draws' sizes."""

    problem: FlybyProblem
    fixed: Array
    draws: Array
    directions: Array

    def __call__(self, weights: Array) -> Array:
        """Of sum_n weights_n T_n, shape (controls,)."""
        feedback = self.problem.feedback
        assert feedback is not None
        gradient = self.fixed * weights.sum()
        for j, burn in enumerate(feedback.burns):
            first, stop = self.problem.controls_before[burn : burn + 2]
            weighed = weights[:, None] * self.directions[j]
            gradient[first : first + 3] = weighed.sum(axis=0)
            gradient[first + 3 : stop] = (weighed.T @ self.draws[:, : 6 * (j + 1)]).ravel()
        return np.asarray(gradient)


def total_sizes(problem: FlybyProblem, iterate: Iterate) -> Array:
    """The sum of the commanded burns' sizes at every draw, shape (DRAWS,)."""
    return _sizes(problem, iterate)[0]


def _sizes(problem: FlybyProblem, iterate: Iterate) -> tuple[Array, _Slopes]:
    """The sum of the burns' sizes at every draw, shape (DRAWS,), and its derivatives."""
    feedback = problem.feedback
    assert feedback is not None
    k = len(feedback.burns)
    draws = normal_points(DRAWS, 6 * k)
    sizes = np.linalg.norm(iterate.burns, axis=1)
    fixed = np.zeros(problem.controls_before[-1])
    fixed[problem.burn_controls] = iterate.burns / np.maximum(sizes, TINY)[:, None]
    sizes[feedback.burns] = 0.0
    total, directions = np.full(DRAWS, sizes.sum()), np.empty((k, DRAWS, 3))
    for j, burn in enumerate(feedback.burns):
        gains = problem.gains_of(iterate, j)
        commanded = iterate.burns[burn] + draws[:, : 6 * (j + 1)] @ gains.T
        size = np.linalg.norm(commanded, axis=1)
        directions[j] = commanded / np.maximum(size, TINY)[:, None]
        total += size
    return total, _Slopes(problem, fixed, draws, directions)


def _quantile(values: Array, width: float) -> float:
    """Quantile of `PROBABILITY` of the smoothed distribution of some values: Newton, bracketed."""
    low, high = float(values.min()) - 10.0 * width, float(values.max()) + 10.0 * width
    at = float(np.quantile(values, PROBABILITY))
    for _ in range(60):
        off = (at - values) / width
        excess = float(ndtr(off).mean()) - PROBABILITY
        low, high = (low, at) if excess > 0.0 else (at, high)
        step = excess * width / max(float(normal_density(off).mean()), TINY)
        following = at - step
        at, before = following if low < following < high else 0.5 * (low + high), at
        if abs(at - before) < 1e-13 * width:
            break
    return at
