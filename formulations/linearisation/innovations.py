"""Innovations of measurements, by a Kalman filter along a plan, as rows of a covariance factor.

E is the factor of the estimate's error: of the state and, below it, of uncertain parameters, which
are estimated with it by their correlations. N is the factor of the measurement's error, in columns of
its own. With Y = E + N and the triangular root W of Y Y',

    Xi = W^-1 Y,    Xi Xi' = I,    E <- E - (E Xi')Xi.

The innovation Xi w has six independent standard normal numbers: the new knowledge from the
measurement. The last equation is the Kalman update. It multiplies from the right, so it commutes
with the flow.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.linalg import solve_triangular

from formulations.arrays import Array

LEARNT = 1e-3
"""Least useful correlation with the state: it reduces a variance by a millionth."""


@dataclass(frozen=True, eq=False)
class Innovation:
    """One measurement's innovation.

    Attributes:
        rows: Xi, shape (6, c).
        root: W, lower triangular, shape (6, 6).
        gain: E Xi' before the update, which is the Kalman gain times W, shape (6 + p, 6).
        axes: orthonormal directions of xi that carry information on the state, shape (6, r). The
            other directions hold almost only the measurement's error.
        correlation: with the state along each of them, shape (r,).
    """

    rows: Array
    root: Array
    gain: Array
    axes: Array
    correlation: Array

    @classmethod
    def of(cls, error: Array, measurement: Array, columns: slice) -> Innovation:
        """Innovation of a measurement with factor N (6, 6), given the estimate's factor E (., c)."""
        measured = error[:6].copy()
        measured[:, columns] += measurement
        root = np.asarray(np.linalg.cholesky(measured @ measured.T))
        rows = np.asarray(solve_triangular(root, measured, lower=True))
        axes, correlation, _ = np.linalg.svd(
            solve_triangular(root, error[:6], lower=True), full_matrices=False
        )
        told = int((correlation >= LEARNT).sum())
        return cls(rows, root, error @ rows.T, axes[:, :told], correlation[:told])

    def by_estimate(self, change: Array) -> Array:
        """Xi along its telling axes, (6, q), from the change G xi of the estimate that it makes."""
        along = self.axes.T @ solve_triangular(self.root, change, lower=True)
        return np.asarray(self.axes @ (along / self.correlation[:, None] ** 2))

    def updated(self, error: Array) -> Array:
        """An estimate's error (., c), here or anywhere along the flow, after the update."""
        return np.asarray(error - (error @ self.rows.T) @ self.rows)

    def derivative(self, d_error: Array) -> Array:
        """Derivative of Xi, shape (6, c, q), by that of E.

        From dW W^-1 = low(W^-1 d(YY') W^-T), with low the lower triangle and half of the diagonal.
        """
        c, q = d_error.shape[1:]
        own = d_error[:6].reshape(6, c * q)
        moved = solve_triangular(self.root, own, lower=True).reshape(6, c, q)
        half = np.einsum("icq,jc->ijq", moved, self.rows)
        low = np.tril(np.ones((6, 6)))[..., None] * (half + half.swapaxes(0, 1))
        low[range(6), range(6)] *= 0.5
        return np.asarray(moved - np.einsum("ijq,jc->icq", low, self.rows))

    def updated_derivative(self, error: Array, d_error: Array, d_rows: Array) -> Array:
        """Derivative of `updated` by those of E (., c) before it and of Xi."""
        along = error @ self.rows.T
        d_along = np.einsum("icq,jc->ijq", d_error, self.rows)
        d_along += np.einsum("ic,jcq->ijq", error, d_rows)
        return np.asarray(
            d_error
            - np.einsum("ijq,jc->icq", d_along, self.rows)
            - np.einsum("ij,jcq->icq", along, d_rows)
        )
