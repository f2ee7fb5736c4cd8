"""The derivative of one function of means and factors by all controls: `condense`, transposed.

For a row that depends on many nodes, one pass backwards through the legs costs less than carrying
the derivatives by all controls forwards.
"""

from __future__ import annotations

import numpy as np
from scipy.linalg import solve_triangular

from formulations.arrays import Array, Indices
from formulations.linearisation.factor import Innovation, after_measurements, corrected, measured_in
from formulations.linearisation.linearisation import Linearisation


def gradient(lin: Linearisation, by_mean: Array, by_factor: Array) -> Array:
    """The derivative by the controls of a function with given derivatives at all nodes.

    Args:
        lin: where it is taken.
        by_mean: by the means' first components, shape (n_nodes, 3 or 6).
        by_factor: by the factor's first rows and columns, shape (n_nodes, 3 or 6, d).
    """
    return _Backward(lin, by_mean, by_factor).slope


class _Backward:
    """Pulls derivatives back from leg to leg, the last one first."""

    def __init__(self, lin: Linearisation, by_mean: Array, by_factor: Array) -> None:
        problem, c = lin.problem, lin.problem.factor_columns
        self._lin, self._problem = lin, problem
        self._slopes = problem.execution_errors.jacobian(lin.iterate.burns)
        every = problem.n_nodes
        size = 6 + problem.parameters
        factor, mean = np.zeros((every, size, c)), np.zeros((every, 6))
        mean[:, : by_mean.shape[1]] = by_mean
        factor[:, : by_factor.shape[1], : by_factor.shape[2]] = by_factor
        k = 0 if problem.feedback is None else len(problem.feedback.burns)
        self.slope = np.zeros(problem.controls_before[-1])
        self._rows = np.zeros((k, 6, c))
        starts, spread = problem.leg_starts, lin.spread
        start = spread.factor[starts]
        inside = np.setdiff1d(np.arange(every), starts)
        legs = problem.legs.of[inside]
        # What the nodes inside the legs pull at their starts.
        d_start, d_mean = factor[starts], np.zeros((len(starts), 7))
        d_mean[:, :6] = mean[starts]
        np.add.at(d_start, legs, spread.stm[inside].swapaxes(1, 2) @ factor[inside])
        np.add.at(d_mean, legs, self._bent(inside, factor[inside], start[legs], mean[inside]))
        shifted = None if problem.firing is None else lin.shifts.factor(spread)
        self._shifted = shifted
        if shifted is not None:
            pulled = lin.shifts.pulled(mean, factor[:, :6], spread.factor)
            self.slope[problem.time_controls] += pulled
        d_error = np.zeros((size, c))
        for leg in range(len(starts) - 1, -1, -1):
            d_error = self._measured(leg, d_error, d_mean)
            burn = leg - problem.coasts
            if burn >= 0:
                self._burnt(burn, d_start[leg], d_error, d_mean[leg])
                if shifted is not None:
                    self.slope[problem.time_controls] += d_mean[leg, :6] @ lin.shifts.mean[burn]
                    self._shift(d_start[leg], shifted.factor[burn])
                    self._shift(d_error, shifted.error[burn])
            if leg > 0:
                here, stm = starts[leg : leg + 1], spread.stm[starts[leg]]
                parts = d_start[leg][None], start[leg - 1 : leg], d_mean[leg, None, :6]
                d_mean[leg - 1] += self._bent(here, *parts)[0]
                d_start[leg - 1] += stm.T @ d_start[leg]
                before = after_measurements(problem, spread, leg - 1)
                none = np.zeros((1, 6))
                d_mean[leg - 1] += self._bent(here, d_error[None], before[None], none)[0]
                d_error = stm.T @ d_error
        d_error = self._measured(-1, d_error, d_mean)
        if shifted is not None:
            self._shift(d_error, shifted.first)

    def _shift(self, by_factor: Array, change: Array) -> None:
        """Derivative by firing times of a factor that changes with them, (6, c, q)."""
        own = np.einsum("ic,icq->q", by_factor[:6], change)
        self.slope[self._problem.time_controls] += own

    def _bent(self, nodes: Indices, by_factor: Array, start: Array, by_mean: Array) -> Array:
        """Pull at the mean at the legs' starts of factors P S and means at nodes, shape (n, 7)."""
        maps = self._lin.affine_map_from_last_burn[nodes, :6]
        pulled = np.einsum("nij,ni->nj", maps, by_mean)
        both = by_factor[:, :6] @ start.swapaxes(1, 2)
        return np.asarray(pulled + np.einsum("nijl,nij->nl", self._lin.bent[nodes], both))

    def _measured(self, leg: int, d_error: Array, d_mean: Array) -> Array:
        """Pull at the estimate's error before a leg's measurements, from that after them."""
        feedback, spread = self._problem.feedback, self._lin.spread
        for j in reversed(list(measured_in(self._problem, leg))):
            assert feedback is not None
            d_error, there = pulled_before(
                spread.innovations[j], spread.errors[j], d_error, self._rows[j]
            )
            if leg < 0:
                d_error = d_error + there
                continue
            if self._shifted is not None:
                self._shift(there, self._shifted.measured[j])
            node = feedback.cut_offs[j : j + 1]
            error = spread.errors[j : j + 1]
            d_mean[leg] += self._bent(node, there[None], error, np.zeros((1, 6)))[0]
            d_error = d_error + spread.stm[node[0]].T @ there
        return d_error

    def _burnt(self, burn: int, d_start: Array, d_error: Array, d_mean: Array) -> None:
        """Derivative by a burn and its gains, and pull of its correction at the innovations."""
        problem, iterate = self._problem, self._lin.iterate
        errors, by, j = (
            problem.execution_errors,
            problem.burn_controls[burn],
            corrected(problem, burn),
        )
        both = (d_start + d_error)[3:6]
        slopes = self._slopes[burn]
        own = np.hstack([both[:, problem.shared_columns], both[:, problem.columns_of_burn(burn)]])
        self.slope[by] = d_mean[3:6] + np.einsum("ic,icj->j", own, slopes)
        if j is None:
            return
        gains, known = problem.gains_of(iterate, j), self._lin.spread.innovations[: j + 1]
        by_gain = d_start[3:6] @ np.vstack([one.rows for one in known]).T
        _, of_gains = errors.correction_columns(gains)
        own = both[:, problem.columns_of_correction(j)[0]]
        by_gain += np.einsum("ic,icab->ab", own, of_gains)
        self.slope[by[-1] + 1 : problem.commanded_controls(j).stop] = by_gain.ravel()
        self._rows[: j + 1] += (gains.T @ d_start[3:6]).reshape(j + 1, 6, -1)


def pulled_before(
    one: Innovation, error: Array, d_error: Array, d_rows: Array
) -> tuple[Array, Array]:
    """Pulls at E before a measurement, from those at E after it and at Xi, in two parts.

    The first is at E where `error` is, the second where it is measured.
    """
    along, pulled = error @ one.rows.T, d_error @ one.rows.T
    d_rows = d_rows - pulled.T @ error - along.T @ d_error
    low = np.tril(d_rows @ one.rows.T)
    low[range(6), range(6)] *= 0.5
    moved = d_rows - (low + low.T) @ one.rows
    there = np.zeros_like(d_error)
    there[:6] = solve_triangular(one.root, moved, lower=True, trans="T")
    return d_error - pulled @ one.rows, there
