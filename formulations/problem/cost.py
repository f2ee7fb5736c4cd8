"""Cost of a plan: the sum of the burns' sizes; with corrected burns its mean or its 99 % quantile.

The law of the commanded sizes, sum_i |v_i + U_i xi|, depends on burns v and gains U alone. Mean and
quantile are taken over fixed quasi-random draws of xi. They are smooth functions of burns and
gains. A burn has about the size

    ||(v, U)|| + s'xi,    s = U'v / ||(v, U)||,

whose first term bounds the mean from above (Jensen's inequality). The 99 % quantile is about sum_i
||(v_i, U_i)|| + 2.326 ||sum_i s_i||. The slope of the quantile equals the slope of a mean over the
draws near the quantile, whose xi are larger than average. The convex program has

    sum_i ||(v_i, U_i) R_i||,    R_i R_i' = sum_n w_n (1, xi_n)(1, xi_n)',

where the weights w of the draws are those in that slope, or equal for the mean. Where burn and
gains vanish, no step costs less than this to first order (Jensen's inequality again). `bends` adds
two terms: 2.326 ||sum_i s_i|| with linearised s_i, for its kink where corrections along burns
cancel, and the curvature of the quantile that the other terms lack. A linear term makes value and
gradient at the iterate equal to those over the draws.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import cached_property, lru_cache
from typing import NamedTuple, Self

import numpy as np
from scipy.special import ndtr, ndtri

from formulations.arrays import Array, Indices
from formulations.problem.flyby import FlybyProblem, Iterate
from formulations.risk.lines import normal_density, normal_points

PROBABILITY = 0.99
QUANTILE = float(ndtri(PROBABILITY))
"""Standard deviations that the 99 % quantile of a normal number lies above its mean."""

SMALLEST = 1e-4
"""Price of gains where corrections cost nothing: among gains of equal worth the smallest are chosen."""

DRAWS = 8192
"""Number of draws of xi for the law of the sizes, a power of two."""

SMOOTH = 0.5
"""Width of the kernel that smooths their distribution, over its standard deviation."""

STEEPEST = 3.0
"""Slope of the cost in the gains of a burn that has vanished, where gains vanish with it: a little more
than the 2.58 standard deviations that hold 99 % of a normal number."""

FAR = 12.0
"""Widths of the kernel beyond which nothing is left of it."""

NOTHING = 1e-12
"""Share of a draw in the kernel that counts as none."""

VANISHED = 1e-7
"""Size over the largest burn up to which the components and gains of a corrected burn count as zero."""

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


class Bend(NamedTuple):
    """Curved part of a cost about an iterate z: ||(R (z' - z) + r, c)||, straight far away.

    Attributes:
        root: R, shape (., controls).
        start: r, shape (.,).
        over: c.
    """

    root: Array
    start: Array
    over: float

    @property
    def at(self) -> Valued:
        """Value at the iterate."""
        size = float(np.hypot(np.linalg.norm(self.start), self.over))
        return Valued(size, self.start @ self.root / max(size, TINY))


def cost(problem: FlybyProblem, iterate: Iterate) -> Valued:
    """The total delta-v that is minimised, as the problem's feedback counts it."""
    feedback = problem.feedback
    if feedback is None or feedback.cost == "nominal" or not iterate.gains.any():
        return formula(problem, iterate, roots_of(problem, iterate))
    if feedback.cost == "expected":
        sizes = _Sizes.of(problem, iterate)
        return Valued(float(sizes.total.mean()), sizes.slope(np.full(DRAWS, 1.0 / DRAWS)))
    if not _corrects(problem, iterate):
        value, gradient = formula(problem, iterate, roots_of(problem, iterate))
        along, _ = size_spread(problem, iterate)
        return Valued(value + QUANTILE * float(np.linalg.norm(along)), gradient)
    sizes = _Sizes.of(problem, iterate)
    return Valued(sizes.quantile.value, sizes.slope(sizes.quantile.by_value))


def formula(problem: FlybyProblem, iterate: Iterate, roots: Sequence[Array]) -> Valued:
    """The sum of all ||(v, U) R||, or with the smallest price of gains, and its gradient."""
    feedback = problem.feedback
    sizes = np.linalg.norm(iterate.burns, axis=1)
    gradient = np.zeros(problem.controls_before[-1])
    gradient[problem.burn_controls] = iterate.burns / np.maximum(sizes, TINY)[:, None]
    total = float(sizes.sum())
    if feedback is None:
        return Valued(total, gradient)
    for j, burn in enumerate(feedback.burns):
        own, gains = problem.commanded_controls(j), problem.gains_of(iterate, j)
        if feedback.cost == "nominal":
            spent = float(np.linalg.norm(gains))
            total += SMALLEST * spent
            gradient[own.start + 3 : own.stop] = SMALLEST * gains.ravel() / max(spent, TINY)
            continue
        weighed = np.column_stack([iterate.burns[burn], gains]) @ roots[j]
        size = float(np.linalg.norm(weighed))
        total += size - sizes[burn]
        slope = weighed @ roots[j].T / max(size, TINY)
        place = own.start + _places(gains.shape[1])
        gradient[place] = 0.0 if _vanished(problem, iterate, j) else slope
    return Valued(total, gradient)


def _vanished(problem: FlybyProblem, iterate: Iterate, j: int) -> bool:
    """Whether nothing but rounding is left of a corrected burn and its gains: the cost has a kink."""
    feedback = problem.feedback
    assert feedback is not None
    own = np.r_[iterate.burns[feedback.burns[j]], problem.gains_of(iterate, j).ravel()]
    return bool(np.abs(own).max() <= VANISHED * problem.dv_max)


def _moved(problem: FlybyProblem) -> Indices:
    """The controls on which corrected burns' sizes depend: times move none."""
    assert problem.feedback is not None
    every = problem.controls_of(problem.feedback.burns.tolist())
    return np.setdiff1d(every, problem.time_controls)


def _corrects(problem: FlybyProblem, iterate: Iterate) -> bool:
    """Whether any gain is more than rounding."""
    return bool(np.abs(iterate.gains).max(initial=0.0) > VANISHED * problem.dv_max)


def _places(known: int) -> Indices:
    """Where (v, U), shape (3, 1 + known), stand among a corrected burn's controls."""
    return np.column_stack([np.arange(3), 3 + np.arange(3 * known).reshape(3, known)])


def roots_of(problem: FlybyProblem, iterate: Iterate) -> list[Array]:
    """R of each corrected burn j, shape (6 j + 7, 6 j + 7); none where corrections cost nothing.

    Where nothing is corrected yet, the quantile has no slope, and R is that of the mean. For a burn
    that has vanished, R is that of the quantile of a norm of normal numbers.
    """
    feedback = problem.feedback
    if feedback is None or feedback.cost == "nominal":
        return []
    if feedback.cost == "dv99" and _corrects(problem, iterate):
        return _Sizes.of(problem, iterate).roots
    roots = []
    for j in range(len(feedback.burns)):
        steep = STEEPEST if feedback.cost == "dv99" and _vanished(problem, iterate, j) else 1.0
        roots.append(np.diag(np.r_[1.0, np.full(6 * (j + 1), steep)]))
    return roots


def bends(problem: FlybyProblem, iterate: Iterate) -> tuple[Bend, Bend]:
    """Curved parts of the 99 % quantile beside `formula`: 2.326 ||sum s_i||, and the rest.

    The first part has a kink where corrections along burns cancel, and where nothing is corrected
    yet. Its c covers all other spread of the sizes. The second part is curvature over the draws.
    """
    feedback = problem.feedback
    assert feedback is not None
    moved = _moved(problem)
    root = np.zeros((len(moved), problem.controls_before[-1]))
    start, jacobian = size_spread(problem, iterate)
    start, jacobian = QUANTILE * start, QUANTILE * jacobian
    if not _corrects(problem, iterate):
        return Bend(jacobian, 0.0 * start, 0.0), Bend(root, root[:, 0], 0.0)
    sizes = _Sizes.of(problem, iterate)
    over, hessian = QUANTILE * sizes.quantile.width, sizes.curvature()
    across = float(np.sqrt(max(over**2 - float(start @ start), 0.0)))
    spread = Bend(jacobian, start, across)
    size, slope = spread.at
    hessian -= (jacobian.T @ jacobian - np.outer(slope, slope)) / size
    for j, (burn, own_root) in enumerate(zip(feedback.burns, sizes.roots, strict=True)):
        if _vanished(problem, iterate, j):
            continue
        gains = problem.gains_of(iterate, j)
        weighed = np.column_stack([iterate.burns[burn], gains]) @ own_root
        size = float(np.linalg.norm(weighed))
        place = int(problem.controls_before[burn]) + _places(gains.shape[1])
        slope = weighed @ own_root.T / size
        curved = np.multiply.outer(np.eye(3), own_root @ own_root.T).swapaxes(1, 2)
        curved -= np.multiply.outer(slope, slope)
        hessian[np.ix_(place.ravel(), place.ravel())] -= curved.reshape(place.size, -1) / size
    values, axes = np.linalg.eigh(hessian[np.ix_(moved, moved)])
    root[:, moved] = np.sqrt(over * np.maximum(values, 0.0))[:, None] * axes.T
    return spread, Bend(root, np.zeros(len(moved)), over)


def size_spread(problem: FlybyProblem, iterate: Iterate) -> tuple[Array, Array]:
    """The sum of all s_i, shape (6 k,), and its derivative by the controls, shape (6 k, controls)."""
    feedback = problem.feedback
    assert feedback is not None
    k = len(feedback.burns)
    value, jacobian = np.zeros(6 * k), np.zeros((6 * k, problem.controls_before[-1]))
    for j, burn in enumerate(feedback.burns):
        v, gains, n = iterate.burns[burn], problem.gains_of(iterate, j), 6 * (j + 1)
        size = max(float(np.sqrt(v @ v + np.sum(gains**2))), VANISHED * problem.dv_max)
        along = v @ gains / size
        value[:n] += along
        place = problem.commanded_controls(j)
        first, stop = place.start, place.stop
        jacobian[:n, first : first + 3] += gains.T / size - np.outer(along, v) / size**2
        own = np.zeros((n, 3, n))
        own[range(n), :, range(n)] = v / size
        own -= along[:, None, None] * gains / size**2
        jacobian[:n, first + 3 : stop] += own.reshape(n, -1)
    return value, jacobian


class _Sizes:
    """The sum of the burns' sizes at every draw, `total` (DRAWS,), and its derivatives."""

    def __init__(self, problem: FlybyProblem, iterate: Iterate) -> None:
        feedback = problem.feedback
        assert feedback is not None
        k = len(feedback.burns)
        draws = normal_points(DRAWS, 6 * k)
        sizes = np.linalg.norm(iterate.burns, axis=1)
        self._fixed = np.zeros(problem.controls_before[-1])
        self._fixed[problem.burn_controls] = iterate.burns / np.maximum(sizes, TINY)[:, None]
        sizes[feedback.burns] = 0.0
        self.total = np.full(DRAWS, sizes.sum())
        self._still = np.setdiff1d(np.arange(len(self._fixed)), _moved(problem))
        self._burns: list[tuple[slice, Array, Array, Array]] = []
        for j, burn in enumerate(feedback.burns):
            known = draws[:, : 6 * (j + 1)]
            commanded = iterate.burns[burn] + known @ problem.gains_of(iterate, j).T
            size = np.maximum(np.linalg.norm(commanded, axis=1), TINY)
            own = problem.commanded_controls(j)
            direction = commanded / size[:, None] * (not _vanished(problem, iterate, j))
            self._burns.append((own, known, size, direction))
            self.total += size

    @classmethod
    @lru_cache(maxsize=2)
    def of(cls, problem: FlybyProblem, iterate: Iterate) -> Self:
        """Sizes of an iterate, cached: value and curvature need the same ones."""
        return cls(problem, iterate)

    @cached_property
    def roots(self) -> list[Array]:
        """R of each corrected burn: see the module."""
        weights = np.maximum(self.quantile.by_value, 0.0)
        known = self._burns[-1][1]
        each = np.sqrt(weights)[:, None] * np.column_stack([np.ones(DRAWS), known])
        root = np.linalg.cholesky(each.T @ each * weights.sum())
        sizes = (1 + own.shape[1] for _, own, _, _ in self._burns)
        return [root[:size, :size] for size in sizes]

    @cached_property
    def quantile(self) -> _Quantile:
        """The 99 % quantile of `total`."""
        return _quantile(self.total)

    def slope(self, weights: Array) -> Array:
        """Gradient of sum_n weights_n T_n by the controls, shape (controls,)."""
        slope = self._fixed * weights.sum()
        for own, known, _, direction in self._burns:
            weighed = weights[:, None] * direction
            slope[own] = np.r_[weighed.sum(axis=0), (weighed.T @ known).ravel()]
        return np.asarray(slope)

    def curvature(self) -> Array:
        """Second derivative of the quantile by the controls, but for that of the kernel's width."""
        at = self.quantile
        some, off = np.flatnonzero(at.weight), self.total - self.total.mean()
        hessian = np.zeros((len(self._fixed),) * 2)
        steps = np.zeros((len(some), len(self._fixed)))
        for own, known, size, direction in self._burns:
            n = own.stop - own.start
            d, xi = direction[some], known[some]
            steps[:, own] = np.hstack([d, (d[:, :, None] * xi[:, None]).reshape(len(some), -1)])
            if not direction.any():
                continue
            block, place = np.zeros((n, n)), _places(n // 3 - 1)
            each = np.column_stack([np.ones(len(known)), known])
            for a in range(3):
                for b in range(3):
                    across = (a == b) - direction[:, a] * direction[:, b]
                    share = across * at.by_value / size
                    block[np.ix_(place[a], place[b])] = (each * share[:, None]).T @ each
            hessian[own, own] = block
        # How far each number comes nearer to the quantile, in the kernel's width.
        narrowed, even = np.sqrt(1.0 + SMOOTH**2), np.full(DRAWS, 1.0 / DRAWS)
        steps += (narrowed - 1.0) * self.slope(even) - narrowed * self.slope(at.by_value)
        by_width = self.slope(off / (DRAWS * at.width))
        steps += narrowed * SMOOTH * at.away[some, None] * by_width
        steps[:, self._still] = 0.0
        share = (at.weight * at.away)[some] / (narrowed**2 * SMOOTH * at.width)
        return hessian + (steps * share[:, None]).T @ steps


def total_sizes(problem: FlybyProblem, iterate: Iterate) -> Array:
    """The sum of the commanded burns' sizes at every draw, shape (DRAWS,)."""
    return _Sizes.of(problem, iterate).total


class _Quantile(NamedTuple):
    """The 99 % quantile of some numbers, smoothed, with the standard deviation `width` of these.

    Attributes:
        value: the quantile.
        width: standard deviation of the numbers.
        by_value: derivative by each number.
        away: the quantile less each number, narrowed, in the kernel's width.
        weight: of each number in the kernel about the quantile.
    """

    value: float
    width: float
    by_value: Array
    away: Array
    weight: Array


def _quantile(values: Array) -> _Quantile:
    """Newton's method, bracketed."""
    mean = float(values.mean())
    width = max(float(values.std()), TINY)
    # The kernel widens the distribution; narrowed beforehand it keeps its variance.
    off, kernel = (values - mean) / np.sqrt(1.0 + SMOOTH**2), SMOOTH * width
    at = _reached(off, kernel)
    away = (at - off) / kernel
    weight = normal_density(away)
    weight /= weight.sum()
    # By the numbers themselves; by their mean; by the kernel's width.
    by_value = weight / np.sqrt(1.0 + SMOOTH**2)
    by_value += (1.0 - by_value.sum()) / len(values)
    by_width = kernel * float(weight @ away) / width
    by_value += by_width * (values - mean) / (len(values) * width)
    return _Quantile(mean + at, width, by_value, away, np.where(weight > NOTHING, weight, 0.0))


def _reached(values: Array, width: float) -> float:
    """Where the smoothed distribution of some numbers reaches `PROBABILITY`."""
    low, high = float(values.min()) - 10.0 * width, float(values.max()) + 10.0 * width
    at = float(np.quantile(values, PROBABILITY))
    near = values[values > at - FAR * width]
    below = len(values) - len(near)
    for _ in range(60):
        off = (at - near) / width
        excess = (below + float(ndtr(off).sum())) / len(values) - PROBABILITY
        low, high = (low, at) if excess > 0.0 else (at, high)
        density = float(normal_density(off).sum()) / len(values)
        following = at - excess * width / max(density, TINY)
        at, before = following if low < following < high else 0.5 * (low + high), at
        if abs(at - before) < 1e-13 * width:
            break
    return at
