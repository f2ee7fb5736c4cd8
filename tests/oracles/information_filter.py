"""Estimate state and parameters of a flight by a square-root information filter.

R (x - x_hat) = v with v ~ N(0, I), so that R'R is the inverse of the covariance (G. J. Bierman,
"Factorization methods for discrete sequential estimation", 1977). Orthogonal transformations alone
update it, by independent measurements and by noise of the velocity. It shares no equation with the
filter along the plan.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from formulations.arrays import Array


@dataclass(frozen=True, eq=False)
class Information:
    """Upper triangular R (n, n), and z = R x_hat (n, flights)."""

    root: Array
    right: Array

    @classmethod
    def before(cls, covariance: Array, flights: int) -> Information:
        """That of a law about zero."""
        whole = np.linalg.inv(np.linalg.cholesky(covariance))
        return cls(np.linalg.qr(whole, mode="r"), np.zeros((len(covariance), flights)))

    @property
    def estimate(self) -> Array:
        """Shape (n, flights)."""
        return np.linalg.solve(self.root, self.right)

    @property
    def covariance(self) -> Array:
        """Shape (n, n)."""
        inverse = np.linalg.inv(self.root)
        return np.asarray(inverse @ inverse.T)

    def measured(self, measured: Array, covariance: Array) -> Information:
        """After the state, the first components, was measured: (6, flights), with errors (6, 6)."""
        weight = np.linalg.inv(np.linalg.cholesky(covariance))
        seen = np.hstack([weight, np.zeros((6, len(self.root) - 6))])
        return self._triangular(
            np.vstack([self.root, seen]), np.vstack([self.right, weight @ measured]), 0
        )

    def carried(self, transition: Array) -> Information:
        """After a coast with transition matrix (n, n)."""
        root = np.linalg.solve(transition.T, self.root.T).T
        return self._triangular(root, self.right, 0)

    def burnt(self, command: Array, covariance: Array) -> Information:
        """After a change of velocity by (3, flights) that is known, and noise of covariance (3, 3)."""
        n = len(self.root)
        added = np.zeros((n, 3))
        added[3:6] = np.linalg.cholesky(covariance)
        known = self.root[:, 3:6] @ command
        noise = np.hstack([np.eye(3), np.zeros((3, n))])
        rows = np.vstack([noise, np.hstack([-self.root @ added, self.root])])
        right = np.vstack([np.zeros((3, command.shape[1])), self.right + known])
        return self._triangular(rows, right, 3)

    @staticmethod
    def _triangular(rows: Array, right: Array, first: int) -> Information:
        """The information on the components after some first ones, which are eliminated."""
        turned = np.linalg.qr(np.hstack([rows, right]), mode="r")
        last = rows.shape[1]
        return Information(turned[first:last, first:last], turned[first:last, last:])
