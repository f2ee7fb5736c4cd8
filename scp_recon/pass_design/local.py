"""The cheapest pass near one: SciPy's SLSQP over phases and times, in rounds of fixed facets."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import numpy.typing as npt
from scipy.optimize import Bounds, LinearConstraint, minimize

from scp_recon.pass_design.near import Found, Near
from scp_recon.pass_design.space import Pass, Space

Array = npt.NDArray[np.float64]

REACH = 0.3
"""Of a round, in rad and in units of time: facets and grid are those of its start."""
ROUNDS_MAX, STEPS_MAX = 12, 20
"""Rounds, and steps of SLSQP in each."""
WORTH = 1e-4
"""Relative gain of a round for which another is worth its time."""
FREE_SPAN = 1e-9

Observe = Callable[[Found], None]


def descend(
    space: Space,
    at: Pass,
    burns_m_s: Array,
    observe: Observe,
    rounds_max: int = ROUNDS_MAX,
    worth: float = WORTH,
    *,
    certain: bool = False,
) -> Found:
    """The best pass that rounds of SLSQP find from one.

    Args:
        space: of the passes.
        at: where it begins.
        burns_m_s: at which the first plan begins, J2000, shape (m, 3).
        observe: called with every plan.
        rounds_max: limit.
        worth: relative gain of a round for which there is another.
        certain: whether uncertainty is left out: P3 in the place of P2.

    Returns:
        Never a worse one than P2 at the start; one that has not converged if that has not.
    """
    near = Near(space, at, burns_m_s, certain=certain)
    best = near.first
    observe(best)
    if not best.converged:
        return best
    for _ in range(rounds_max):
        x, burns = _round(space, near, observe)
        near = Near(space, space.at(x), burns, certain=certain)
        gain = 1.0 - near.first.dv_m_s / best.dv_m_s
        observe(near.first)
        if gain > 0.0:
            best = near.first
        if gain < worth:
            break
    return best


def _round(space: Space, near: Near, observe: Observe) -> tuple[Array, Array]:
    """The cheapest x that SLSQP finds within reach, and the burns there."""
    start, low, high = space.vector(near.first.at), *space.bounds.T
    free = high - low > FREE_SPAN
    matrix, least = space.rules(space.before(near.first.at.times_s))
    before = near.first
    unit, scale = before.mission.units.speed_m_s, before.dv_m_s
    best, last = before, before

    def cost(y: Array) -> tuple[float, Array]:
        nonlocal best, last
        x = start.copy()
        x[free] = y
        found = near.plan(x, last.stage.result.lin)
        observe(found)
        if not found.converged:  # the line search turns back
            return 10.0, np.zeros(len(y))
        last = found
        best = min(best, found, key=lambda one: one.dv_m_s)
        return found.dv_m_s / scale, near.slope(found, free)[free] * (unit / scale)

    reach = Bounds(
        np.maximum(low, start - REACH)[free], np.minimum(high, start + REACH)[free], True
    )
    felt = np.any(matrix[:, free], axis=1)  # the others hold, for times that are given
    room = least - matrix[:, ~free] @ start[~free]
    rules = [LinearConstraint(matrix[felt][:, free], room[felt], np.inf)] if felt.any() else []
    minimize(
        cost,
        start[free],
        jac=True,
        method="SLSQP",
        bounds=reach,
        constraints=rules,
        options={"maxiter": STEPS_MAX, "ftol": 0.1 * WORTH},
    )
    return space.vector(best.at), best.burns_m_s
