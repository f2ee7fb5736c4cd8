"""The grid: nodes at the burns and the window's edges, and evenly between them."""

from __future__ import annotations

import itertools

import numpy as np
import numpy.typing as npt

Array = npt.NDArray[np.float64]

RK4_STEP_MAX_S = 240.0
"""Keeps the planner within a millimetre of an adaptive integration over the default flight."""


def make_grid(fixed_s: tuple[float, ...], step_max_s: float) -> Array:
    """Ascending times that contain `fixed_s`, evenly spaced by at most `step_max_s` between them."""
    fixed = np.unique(fixed_s)
    parts = [
        np.linspace(a, b, max(1, int(np.ceil((b - a) / step_max_s - 1e-9))) + 1)[:-1]
        for a, b in itertools.pairwise(fixed)
    ]
    return np.concatenate([*parts, fixed[-1:]])
