"""Flow map of all arcs at once, with its first- and second-order sensitivities.

Fourth-order Runge-Kutta with a fixed number of substeps. Differentiating the scheme and applying
the scheme to the variational equations are the same thing, so the sensitivities returned here are
the exact derivatives of the discrete map, not approximations of those of the continuous one.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from scp_recon.forces import ForceModel, acceleration, acceleration_derivatives

Array = npt.NDArray[np.float64]


@dataclass(frozen=True)
class FlowDerivatives:
    """Arc-wise end states and sensitivities.

    Attributes:
        state: F(x), shape (n, 6).
        stm: A[n, i, j] = dF_i/dx_j, shape (n, 6, 6).
        tensor: T[n, i, j, k] = d2F_i/dx_j dx_k, shape (n, 6, 6, 6), symmetric in j and k.
    """

    state: Array
    stm: Array
    tensor: Array


def propagate(
    state: Array, duration: Array | float, forces: ForceModel, substeps: int = 1
) -> Array:
    """Carry states over their arcs; `state` (..., 6), `duration` broadcast against (...)."""

    def autonomous(r: Array, _: Any) -> Array:
        return np.stack(acceleration(r[0], r[1], r[2], forces))

    return rk4(state, duration, autonomous, substeps)


def rk4(
    state: Array,
    duration: Array | float,
    rate: Callable[[Array, Any], Array],
    substeps: int,
) -> Array:
    """Fourth-order Runge-Kutta for an acceleration of the position (3, ...) and the elapsed time.

    `state` has shape (..., 6) and `duration` broadcasts against (...).
    """
    r = np.moveaxis(np.asarray(state)[..., :3], -1, 0)
    v = np.moveaxis(np.asarray(state)[..., 3:], -1, 0)
    h = np.asarray(duration) / substeps
    for k in range(substeps):
        t = k * h
        a1 = rate(r, t)
        v2 = v + 0.5 * h * a1
        a2 = rate(r + 0.5 * h * v, t + 0.5 * h)
        v3 = v + 0.5 * h * a2
        a3 = rate(r + 0.5 * h * v2, t + 0.5 * h)
        v4 = v + h * a3
        a4 = rate(r + h * v3, t + h)
        r = r + h / 6.0 * (v + 2.0 * v2 + 2.0 * v3 + v4)
        v = v + h / 6.0 * (a1 + 2.0 * a2 + 2.0 * a3 + a4)
    return np.moveaxis(np.concatenate([r, v]), 0, -1)


def differentiate(
    state: Array, duration: Array, forces: ForceModel, substeps: int = 1
) -> FlowDerivatives:
    """Flow map, state-transition matrix and second-order tensor of every arc in one call.

    Args:
        state: initial states, shape (n, 6).
        duration: arc lengths, shape (n,).
        forces: constants in the same units.
        substeps: Runge-Kutta steps per arc.
    """
    n = len(state)
    h = np.asarray(duration) / substeps
    # One array per half (position, velocity) and columns (state, first order, second order), so
    # that a Runge-Kutta stage is one expression: 1 + 6 + 36 columns.
    y = np.zeros((n, 2, 3, 43))
    y[:, :, :, 0] = np.reshape(state, (n, 2, 3))
    y[:, :, :, 1:7] = np.eye(6).reshape(2, 3, 6)
    w = h[:, None, None, None]
    for _ in range(substeps):
        k1 = _variational_rate(y, forces)
        k2 = _variational_rate(y + 0.5 * w * k1, forces)
        k3 = _variational_rate(y + 0.5 * w * k2, forces)
        k4 = _variational_rate(y + w * k3, forces)
        y = y + w / 6.0 * (k1 + 2.0 * k2 + 2.0 * k3 + k4)
    columns = y.reshape(n, 6, 43)
    tensor = columns[:, :, 7:].reshape(n, 6, 6, 6)
    return FlowDerivatives(columns[:, :, 0], columns[:, :, 1:7], tensor)


def _variational_rate(y: Array, forces: ForceModel) -> Array:
    """Right-hand side of state, first- and second-order variational equations, (n, 2, 3, 43)."""
    n = len(y)
    value, gradient, second = acceleration_derivatives(y[:, 0, :, 0], forces)
    rate = np.empty_like(y)
    rate[:, 0] = y[:, 1]
    rate[:, 1, :, 0] = value
    rate[:, 1, :, 1:] = gradient @ y[:, 0, :, 1:]
    phi = y[:, 0, :, 1:7]
    # sum_lm H_ilm phi_lj phi_mk
    inner = np.matmul(second, phi[:, None])  # (n, i, l, k)
    curved = np.matmul(phi.transpose(0, 2, 1)[:, None], inner)  # (n, i, j, k)
    rate[:, 1, :, 7:] += curved.reshape(n, 3, 36)
    return rate
