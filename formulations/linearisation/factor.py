"""The covariance factor along a flight and its derivatives, open loop or with corrected burns.

Each column belongs to one source of error: the initial state, the execution of a burn, or a
measurement; or an uncertain parameter, which is constant: its rows stand below those of the state,
in S and in E. A correction is U Xi, with the innovations Xi of the measurements:

    S <- S + B U Xi + B C(dv) + B D(U)    at a corrected burn,
    E <- E + B C(dv) + B D(U),

S is the factor of the deviation, and E that of the estimate's error. C are the error columns of the
planned burn, D those of the correction. For given STMs, S is affine in burns and gains, except
through D and through the effect of the burns on Xi. Both are of second order in the execution
errors.

The innovations of measurements are those of a Kalman filter along the plan. Uncertain parameters
are estimated with the state by their correlations. N is the factor of the measurement's error, in
columns of its own. With Y = E + N and the triangular root W of Y Y',

    Xi = W^-1 Y,    Xi Xi' = I,    E <- E - (E Xi')Xi.

The innovation Xi w has six independent standard normal numbers: the new knowledge from the
measurement. The last equation is the Kalman update. It multiplies from the right, so it commutes
with the flow.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np
from scipy.linalg import solve_triangular

from formulations.arrays import Array, Indices
from formulations.problem.flyby import FlybyProblem, Iterate

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


@dataclass(frozen=True, eq=False)
class Spread:
    """The covariance factor of an iterate, and what its measurements tell.

    Attributes:
        factor: S at every node, after the burn where there is one, shape (n_nodes, 6 + p, c).
        innovations: of each measurement.
        errors: E at the start of the leg in which each measurement is made, before it, (k, 6 + p, c).
        stm: from the last burn to each node, shape (n_nodes, 6 + p, 6 + p).
        leg_errors: E after each leg's start, none of the leg's measurements made,
            (legs + 1, 6 + p, c).
    """

    factor: Array
    innovations: tuple[Innovation, ...]
    errors: Array
    stm: Array
    leg_errors: Array


class Shifted(NamedTuple):
    """Changes of the state's rows of factors by q firing times and phases, at given times.

    Attributes:
        first: of E before the first measurement, shape (6, c, q).
        factor: of S right after each burn, shape (m, 6, c, q).
        error: of E there.
        measured: of E before each measurement, which moves along with its cut-off, (k, 6, c, q).
    """

    first: Array
    factor: Array
    error: Array
    measured: Array


class Filter(NamedTuple):
    """What the filter of a flight knows.

    Attributes:
        error: E at every node, after measurement and burn, shape (n_nodes, 6 + p, c).
        before: E before each measurement, (k, 6 + p, c).
        innovations: of each measurement; they depend on each other if parameters are considered.
        estimated: number of components that it estimates: those of the state, and p or none.
    """

    error: Array
    before: tuple[Array, ...]
    innovations: tuple[Innovation, ...]
    estimated: int

    def after(self, j: int) -> Array:
        """E of what is estimated after a measurement, shape (estimated, c)."""
        return self.innovations[j].updated(self.before[j][: self.estimated])


def factor_of(covariance: Array) -> Array:
    """Factor S of a covariance S S', which may be singular, by the eigenvalues of the correlations.

    Negative eigenvalues come from rounding and count as zero.
    """
    sigma = np.sqrt(np.diag(covariance))
    known = np.where(sigma > 0.0, sigma, 1.0)
    scaled = covariance / np.outer(known, known)
    values, vectors = np.linalg.eigh(0.5 * (scaled + scaled.T))
    return np.asarray(known[:, None] * vectors * np.sqrt(np.maximum(values, 0.0)))


def propagate_factor(problem: FlybyProblem, stm: Array, iterate: Iterate) -> Spread:
    """Factors of deviation and estimate's error, from the STMs from the last burn to each node.

    Columns of later burns and measurements are zero.
    """
    legs, feedback = problem.legs, problem.feedback
    shape = len(problem.leg_starts), 6 + problem.parameters, problem.factor_columns
    start, leg_errors, at_measurement = np.zeros(shape), np.zeros(shape), []
    first = np.zeros(shape[1:])
    first[:, : problem.first_factor.shape[1]] = problem.first_factor
    innovations: list[Innovation] = []
    columns = problem.execution_errors.columns(iterate.burns)

    def measure(error: Array, leg: int) -> Array:
        for j in measured_in(problem, leg):
            assert feedback is not None
            at_measurement.append(error)
            there = stm[feedback.cut_offs[j]] @ error if leg >= 0 else error
            _, own = problem.columns_of_correction(j)
            innovations.append(Innovation.of(there, feedback.measurement[j], own))
            error = innovations[-1].updated(error)
        return error

    start[0] = first
    error = measure(first, -1)
    for leg in range(len(start)):
        if leg > 0:
            start[leg] = stm[legs.ends[leg - 1]] @ start[leg - 1]
            error = stm[legs.ends[leg - 1]] @ error
        burn = leg - problem.coasts
        if burn >= 0:
            j = corrected(problem, burn)
            if j is not None:
                rows = np.vstack([one.rows for one in innovations[: j + 1]])
                start[leg, 3:6] += problem.gains_of(iterate, j) @ rows
            for factor in (start[leg], error):
                _add_errors(problem, iterate, burn, columns[burn], factor)
        leg_errors[leg] = error
        error = measure(error, leg)
    factor = stm @ start[legs.of]
    factor[problem.leg_starts] = start
    errors = np.array(at_measurement).reshape(-1, *shape[1:])
    return Spread(factor, tuple(innovations), errors, stm, leg_errors)


def flight_filter(
    problem: FlybyProblem, stm_of_arcs: Array, iterate: Iterate, estimated: int
) -> Filter:
    """Kalman's filter, which estimates the parameters with the state, or Schmidt's: 6 are `estimated`.

    Schmidt's considers the parameters: its estimates of them stay zero, and it weighs measurements by
    the errors that parameters cause, too (S. F. Schmidt, "Application of state-space methods to
    navigation problems", 1966). STMs are of state and parameters along the arcs, shape
    (n_nodes - 1, 6 + p, 6 + p).
    """
    feedback = problem.feedback
    found = np.zeros((problem.n_nodes, 6 + problem.parameters, problem.factor_columns))
    found[0, :, : problem.first_factor.shape[1]] = problem.first_factor
    columns = problem.execution_errors.columns(iterate.burns)
    before: list[Array] = []
    innovations: list[Innovation] = []
    for node, error in enumerate(found):
        if node > 0:
            error[:] = stm_of_arcs[node - 1] @ found[node - 1]
        if feedback is not None:
            for j in np.flatnonzero(feedback.cut_offs == node).tolist():
                _, own = problem.columns_of_correction(j)
                before.append(error.copy())
                innovations.append(Innovation.of(error, feedback.measurement[j], own))
                error[:estimated] = innovations[-1].updated(error[:estimated])
        for burn in np.flatnonzero(problem.burn_nodes == node).tolist():
            _add_errors(problem, iterate, burn, columns[burn], error)
    return Filter(found, tuple(before), tuple(innovations), estimated)


def after_measurements(problem: FlybyProblem, spread: Spread, leg: int) -> Array:
    """Factor E of the estimate's error at a leg's start, after its measurements, shape (6 + p, c)."""
    error = spread.leg_errors[leg]
    for j in measured_in(problem, leg):
        error = spread.innovations[j].updated(error)
    return error


def measured_in(problem: FlybyProblem, leg: int) -> Iterator[int]:
    """Measurements made along a leg, its end included; -1 is before the first node's burn."""
    if problem.feedback is None or leg >= len(problem.leg_starts) - 1:
        return
    low = problem.leg_starts[leg] if leg >= 0 else -1
    high = problem.leg_starts[leg + 1] if leg >= 0 else 0
    for j in np.flatnonzero(
        (problem.feedback.cut_offs > low) & (problem.feedback.cut_offs <= high)
    ):
        yield int(j)


def corrected(problem: FlybyProblem, burn: int) -> int | None:
    """Number of a burn among the corrected ones; None if it is not corrected."""
    if problem.feedback is None or burn not in problem.feedback.burns:
        return None
    return int(np.searchsorted(problem.feedback.burns, burn))


def _add_errors(
    problem: FlybyProblem, iterate: Iterate, burn: int, columns: Array, factor: Array
) -> None:
    """Add a burn's errors of execution, and its correction's, to a factor (6 + p, c) at its node."""
    errors, j = problem.execution_errors, corrected(problem, burn)
    factor[3:6, problem.shared_columns] += columns[:, : errors.shared]
    factor[3:6, problem.columns_of_burn(burn)] = columns[:, errors.shared :]
    if j is not None and iterate.gains.size:
        own, _ = errors.correction_columns(problem.gains_of(iterate, j))
        factor[3:6, problem.columns_of_correction(j)[0]] = own


class FactorSensitivity:
    """Derivatives of the factor by all controls and, last, by closing the defects: by legs.

    With P the STM from a leg's start, d(P S) = P dS + (T . dmu) S there. Rows of parameters change only
    in E, as it learns: without measurements the derivatives have no such rows.

    Args:
        problem: of the iterate.
        iterate: burns, means and gains.
        spread: its factors.
        moved: deviations of the mean at the legs' starts by control, shape (legs + 1, 7, q).
        bent: derivatives of the STMs from the legs' starts by the deviation there, shape
            (n_nodes, 6, 6 + p, 7); None if they are held.
        shifted: changes by the firing times (`Shifts.factor`), if these are controls.
    """

    def __init__(
        self,
        problem: FlybyProblem,
        iterate: Iterate,
        spread: Spread,
        moved: Array,
        bent: Array | None,
        shifted: Shifted | None = None,
    ) -> None:
        self._problem, self._iterate, self._spread = problem, iterate, spread
        self._shifted, self._moved, self._bent = shifted, moved, bent
        self._slopes = problem.execution_errors.jacobian(iterate.burns)
        rows = 6 if problem.feedback is None else 6 + problem.parameters
        self._shape = rows, problem.factor_columns, moved.shape[-1]

    def at(self, nodes: Indices) -> Array:
        """The derivative at some nodes, shape (n, 6 or 6 + p, c, q)."""
        problem, starts = self._problem, self._problem.leg_starts
        start, factors, legs = self.starts, self._spread.factor[starts], problem.legs.of[nodes]
        derivative = self._reached(nodes, start[legs], factors[legs])
        last = np.searchsorted(starts, nodes)
        here = starts[last] == nodes
        derivative[here] = start[last[here]]
        return derivative

    def kicks(self) -> Array:
        """Derivative of each burn's additions to the factor at its node, (m, 6 or 6 + p, c, q)."""
        kicks = np.zeros((self._problem.n_burns, *self._shape))
        for burn, kick in enumerate(kicks):
            self._corrected(burn, kick, self._starts[1])
            self._add_errors(burn, kick)
            if self._shifted is not None:
                kick[:6, ..., self._problem.time_controls] += self._shifted.factor[burn]
        return kicks

    @property
    def starts(self) -> Array:
        """The derivatives at the legs' starts, after the burns there, (legs + 1, 6 or 6 + p, c, q)."""
        return self._starts[0]

    @cached_property
    def _starts(self) -> tuple[Array, Array]:
        """`starts`, and the derivatives of all Xi."""
        problem, spread = self._problem, self._spread
        starts, shifted, timed = problem.leg_starts, self._shifted, problem.time_controls
        start = np.zeros((len(starts), *self._shape))
        d_error, d_rows = np.zeros(self._shape), np.zeros((0, *self._shape[1:]))
        if shifted is not None:
            d_error[:6, ..., timed] = shifted.first
        d_error, d_rows = self._measured(-1, d_error, d_rows)
        for leg in range(len(starts)):
            there = starts[leg : leg + 1]
            if leg > 0:
                before = start[leg - 1 : leg], spread.factor[None, starts[leg - 1]]
                start[leg] = self._reached(there, *before)[0]
                if problem.feedback is not None:
                    error = after_measurements(problem, spread, leg - 1)
                    d_error = self._reached(there, d_error[None], error[None])[0]
            burn = leg - problem.coasts
            if burn >= 0:
                self._corrected(burn, start[leg], d_rows)
                self._add_errors(burn, start[leg])
                self._add_errors(burn, d_error)
                if shifted is not None:
                    start[leg][:6, ..., timed] += shifted.factor[burn]
                    d_error[:6, ..., timed] += shifted.error[burn]
            d_error, d_rows = self._measured(leg, d_error, d_rows)
        return start, d_rows

    def _reached(self, nodes: Indices, start: Array, factor: Array) -> Array:
        """Derivatives at nodes of factors (n, 6 + p, c) at their legs' starts, with those there."""
        rows, c, q = self._shape
        derivative = self._spread.stm[nodes, :rows, :rows] @ start.reshape(-1, rows, c * q)
        derivative = derivative.reshape(-1, rows, c, q)
        if self._bent is not None:
            legs = self._problem.legs.of[nodes]
            d_stm = self._bent[nodes] @ self._moved[legs][:, None]  # (n, 6, 6 + p, q)
            derivative[:, :6] += factor[:, None].swapaxes(-1, -2) @ d_stm
        return np.asarray(derivative)

    def _measured(self, leg: int, d_error: Array, d_rows: Array) -> tuple[Array, Array]:
        """Derivatives of E after a leg's measurements, at its start, and of all Xi so far."""
        feedback, spread = self._problem.feedback, self._spread
        for j in measured_in(self._problem, leg):
            assert feedback is not None
            one, error = spread.innovations[j], spread.errors[j]
            there, node = d_error, feedback.cut_offs[j : j + 1]
            if leg >= 0:
                there = self._reached(node, d_error[None], error[None])[0]
            if self._shifted is not None:
                there = there.copy()
                there[:6, ..., self._problem.time_controls] += self._shifted.measured[j]
            rows = one.derivative(there)
            d_error = one.updated_derivative(error, d_error, rows)
            d_rows = np.concatenate([d_rows, rows])
        return d_error, d_rows

    def _corrected(self, burn: int, start: Array, d_rows: Array) -> None:
        """Add the correction of a burn to the derivative (., c, q) at its node."""
        problem, j = self._problem, corrected(self._problem, burn)
        if j is None:
            return
        gains, n = problem.gains_of(self._iterate, j), 6 * (j + 1)
        start[3:6] += np.einsum("an,ncq->acq", gains, d_rows[:n])
        rows = np.vstack([one.rows for one in self._spread.innovations[: j + 1]])
        own = problem.commanded_controls(j)
        for axis, by in enumerate(np.arange(own.start + 3, own.stop).reshape(3, n)):
            start[3 + axis][:, by] += rows.T

    def _add_errors(self, burn: int, start: Array) -> None:
        """Add the derivatives of a burn's errors of execution, and of its correction's."""
        problem, errors = self._problem, self._problem.execution_errors
        j, slopes = corrected(problem, burn), self._slopes[burn]
        first = int(problem.controls_before[burn])
        place = slice(first, first + 3)
        start[3:6, problem.shared_columns, place] += slopes[:, : errors.shared]
        start[3:6, problem.columns_of_burn(burn), place] += slopes[:, errors.shared :]
        if j is not None:
            _, of_gains = errors.correction_columns(problem.gains_of(self._iterate, j))
            place = slice(first + 3, problem.commanded_controls(j).stop)
            own = of_gains.reshape(3, of_gains.shape[1], -1)
            start[3:6, problem.columns_of_correction(j)[0], place] += own
