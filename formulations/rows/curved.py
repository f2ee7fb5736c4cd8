"""Rows with value, slope and concave curvature as second-order cones: see `exact`."""

from __future__ import annotations

import numpy as np

from formulations.problem.flyby import Nodes
from formulations.problem.regions import Array
from formulations.rows.cones import Cones

BEND = 3.0
"""c: standard deviations over which a row bends before it goes on straight."""


def curved_cones(rows: Nodes, margin: Array, slope: Array, hessian: Array, z: Array) -> Cones:
    """Rows margin + slope'd + d'hessian d/2 >= 0 in d about z, their concave part as in the module.

    Args:
        rows: which of the buffers each has, shape (r,).
        margin: at z, shape (r,).
        slope: shape (r, p).
        hessian: shape (r, p, p); its negative part counts.
        z: burns where they are made, shape (p,).
    """
    r, p = slope.shape
    curvature, axes = np.linalg.eigh(-0.5 * (hessian + hessian.swapaxes(1, 2)))
    bend = np.sqrt(BEND * np.maximum(curvature, 0.0))[:, :, None] * axes.swapaxes(1, 2)
    curved = np.any(bend, axis=(1, 2))
    tail = np.zeros((r, p + 1, p + 1))
    tail[:, :p, :p], tail[:, :p, p] = bend, -bend @ z
    tail[curved, p, p] = BEND
    head = np.column_stack([slope, margin - slope @ z + BEND * curved])
    both = np.concatenate([head[:, None], np.linalg.qr(tail, mode="r")], axis=1)
    return Cones(rows, both[..., :-1], both[..., -1], triangular=True)
