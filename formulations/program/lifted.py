"""Lifted: mean, covariance factor and virtual control as explicit variables, sparse.

    mu_{k+1} = mu^_{k+1} + A_k (mu_k - mu^_k) + d_k + B (dv_i - dv^_i)
    S_{k+1}  = [A_k S_k + (T_k . (mu_k - mu^_k)) S^_k, B (C^_i + C'^_i . (dv_i - dv^_i))]

with hats for the iterate, d for its defects and C for the columns of a burn's errors. Nodes are those
that a constraint or a burn touches; the arcs between are composed, which is exact to the order of the
linearisation and keeps the program a tenth of its size. The dynamics are one product of a block-sparse
parameter with all states stacked (every mean, then every factor, row-major), so that the sparsity is
constant.

The virtual control is the miss of the final state. Any burns have a trajectory, so that this is all
the linearised dynamics can miss; on other arcs it would promise to move the path at the price of a
miss, which no flight keeps.
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass, replace
from time import perf_counter
from typing import Any

import cvxpy as cp
import numpy as np
import scipy.sparse as sp

from formulations.arrays import Array, Indices
from formulations.linearisation.linearisation import (
    Linearisation,
    LinearisationError,
    require_finite,
)
from formulations.problem.flyby import FlybyProblem, Iterate, StateConstraint, factor_columns_used
from formulations.program.convex_subproblem import ConvexSubproblem
from formulations.program.model import (
    CompiledProgram,
    StateModel,
    Values,
    sparse_parameter,
    write_model,
)
from formulations.program.solvers import FallbackSolver
from formulations.program.subproblem import Penalty, PenaltyParameters, Step, SubproblemError
from formulations.rows.cones import Rows
from formulations.rows.uniform import ChanceRows, DeterministicRows

SETTINGS = {"CLARABEL": {"static_regularization_constant": 1e-7}}
"""With the default 1e-8 Clarabel's factorisation breaks down short of the tolerances."""


class LiftedSubproblem(ConvexSubproblem):
    """The textbook form of P3 or P2 around an iterate."""

    def __init__(self, problem: FlybyProblem, rows: Rows, penalty: Penalty, solver: str) -> None:
        super().__init__(problem, rows, penalty, FallbackSolver(solver, SETTINGS))
        self._dynamics = LiftedDynamics(problem, rows.nodes, rows.with_factor)
        self._compiled: CompiledProgram | None = None

    def update(self, lin: Linearisation) -> None:
        """Convexify at an iterate. Raises as `Subproblem.update` does."""
        try:
            values = self._dynamics.values(lin)
        except LinearisationError as error:
            raise SubproblemError(str(error)) from error
        self._at, self._values = lin, values | keep_out_values(self.rows, lin)

    def _attempt(self, radius: float, charge: PenaltyParameters, planes: Array) -> Step:
        start = perf_counter()
        if self._compiled is None:
            model = write_model(self.problem.n_burns, self._penalty, self._write_states)
            self._compiled = CompiledProgram(model)
        every = np.arange(self.rows.count)
        step = self._solve(self._compiled, radius, charge, planes, self._values, every)
        return replace(step, canonicalise_s=perf_counter() - start - step.solver_s)

    def _write_states(self, burns: cp.Variable) -> StateModel:
        outputs, miss, constraints, parameters = self._dynamics.write(burns)
        if isinstance(self.rows, ChanceRows):
            return StateModel(miss, _chance_rows(self.rows, outputs), constraints, parameters)
        assert isinstance(self.rows, DeterministicRows)
        rows, planes = _deterministic_rows(self.rows, outputs)
        return StateModel(miss, rows, constraints, parameters | planes)


class LiftedDynamics:
    """The linearised dynamics of mean and factor as sparse equations, with outputs at some nodes."""

    def __init__(self, problem: FlybyProblem, nodes: Indices, with_factor: bool) -> None:
        self._problem, self._used = problem, nodes
        self._nodes = np.union1d(nodes, problem.leg_starts)
        factor = with_factor and len(nodes) > 0
        self._columns = factor_columns_used(problem, nodes) if factor else 0
        self._arcs = len(self._nodes) - 1
        # The factor is needed up to the last node that a constraint looks at.
        self._factor_arcs = int(np.searchsorted(self._nodes, nodes[-1])) if self._columns else 0
        self._mean_size = 6 * (self._arcs + 1)
        self._size = self._mean_size + 6 * self._columns * (self._factor_arcs + 1)
        # Rows of the states that no arc ends in: the mean and the factor at the first node.
        self._ends = np.r_[6 : self._mean_size, self._mean_size + 6 * self._columns : self._size]
        self._starts = np.setdiff1d(np.arange(self._size), self._ends)
        self._burns = np.searchsorted(self._nodes, problem.burn_nodes)
        where = (self._burns, self._mean_size, self._columns, self._factor_arcs, self._size)
        self._errors = LiftedErrors(problem, *where)

    def write(
        self, burns: cp.Variable
    ) -> tuple[cp.Expression, cp.Expression, list[cp.Constraint], dict[str, cp.Parameter]]:
        """Position and factor rows of the used nodes, (3 n, 1 + c); miss; equations; parameters."""
        n, columns, ends, starts = self._mean_size, self._columns, self._ends, self._starts
        states, virtual = cp.Variable(self._size), cp.Variable(6)
        entries, stepping = sparse_parameter((len(ends), self._size), *self._pattern())
        constant, start = cp.Parameter(len(ends)), cp.Parameter(len(starts))
        final = cp.Parameter(6)
        parameters = {"stepping": entries, "constant": constant, "start": start, "final": final}
        kicks: Any = self._kicks()
        if not self._errors.affine:
            shape = (self._size, burns.size)
            parameters["errors"], errors = sparse_parameter(shape, *self._errors.places)
            kicks = kicks + errors
        constraints: list[cp.Constraint] = [
            states[starts] == start + kicks[starts] @ burns,
            states[ends] == stepping @ states + constant + kicks[ends] @ burns,
            states[n - 6 : n] == final + virtual,
        ]
        pick = self._pick(np.searchsorted(self._nodes, self._used), self._size)
        outputs = cp.reshape(pick @ states, (3 * len(self._used), 1 + columns), order="C")
        return outputs, virtual, constraints, parameters

    def _pattern(self) -> tuple[Indices, Indices]:
        """Rows of the dynamics and the state entries that the parameter connects to them.

        In this order: A_k on the mean; A_k on every factor column; T_k . S^_k from the mean.
        """
        k, i, j = np.meshgrid(np.arange(self._arcs), np.arange(6), np.arange(6), indexing="ij")
        mean_row, mean_entry = 6 * k + i, 6 * k + j
        c = self._columns
        k, i, col, j = np.meshgrid(
            np.arange(self._factor_arcs), np.arange(6), np.arange(c), np.arange(6), indexing="ij"
        )
        factor_row = 6 * self._arcs + (6 * k + i) * c + col
        own, from_mean = self._mean_size + (6 * k + j) * c + col, 6 * k + j
        rows = np.concatenate([mean_row.ravel(), factor_row.ravel(), factor_row.ravel()])
        return rows, np.concatenate([mean_entry.ravel(), own.ravel(), from_mean.ravel()])

    def _kicks(self) -> sp.csr_array:
        """What burns add: B dv to means and, where linear, B C(dv) to factors, (states, 3 burns)."""
        rows = np.add.outer(6 * self._burns + 3, np.arange(3)).ravel()
        entries = np.ones(len(rows)), (rows, np.arange(len(rows)))
        kicks = sp.csr_array(entries, shape=(self._size, len(rows)))
        return kicks + self._errors.constant(self._problem) if self._errors.affine else kicks

    def _pick(self, nodes: Indices, size: int) -> sp.csr_array:
        """Position rows (mean, factor columns) of the used nodes among the stacked states."""
        component = np.add.outer(6 * nodes, np.arange(3))
        factor = np.add.outer(self._mean_size + component * self._columns, np.arange(self._columns))
        chosen = np.concatenate([component[..., None], factor], axis=2).ravel()
        ones = np.ones(len(chosen))
        return sp.csr_array((ones, (np.arange(len(chosen)), chosen)), shape=(len(chosen), size))

    def values(self, lin: Linearisation) -> Values:
        """The parameters for an iterate.

        Raises:
            LinearisationError: if they are not finite.
        """
        n, c, arcs = self._factor_arcs, self._columns, compose(lin, self._nodes)
        start = lin.problem.first_factor[:, :c]
        start = np.pad(start, ((0, 0), (0, c - start.shape[1])))
        own = np.broadcast_to(arcs.stm[:n, :, None, :], (n, 6, c, 6))
        factor = lin.factor[self._nodes[:n], :, :c]
        # (T_k . dmu) S^_k: rows i, factor column c, mean component l.
        curved = np.einsum("kijl,kjc->kicl", arcs.tensor[:n], factor, optimize=True)
        mean = lin.iterate.mean[self._nodes]
        factor_constant = arcs.shift_stm[:n] @ factor - np.einsum("kicl,kl->kic", curved, mean[:n])
        mean_constant = self._mean_constant(lin, mean, arcs.stm, arcs.shift)
        values = {
            "stepping": np.concatenate([arcs.stm.ravel(), own.ravel(), curved.ravel()]),
            "constant": np.concatenate([mean_constant.ravel(), factor_constant.ravel()]),
            "start": np.r_[lin.problem.initial_state, start.ravel()],
            "final": lin.problem.final_state,
        }
        if not self._errors.affine:
            left = self._errors.remainder(lin.problem, lin.iterate)
            values["constant"] += left[self._ends]
            values["start"] += left[self._starts]
            values["errors"] = self._errors.derivative(lin.problem, lin.iterate.burns)
        return values

    def _mean_constant(self, lin: Linearisation, mean: Array, stm: Array, shift: Array) -> Array:
        """mu^_{k+1} - A_k mu^_k + d_k - B dv^_i, (arcs, 6)."""
        constant = mean[1:] - np.einsum("kij,kj->ki", stm, mean[:-1]) + shift
        later = lin.problem.burn_nodes > 0
        at = np.searchsorted(self._nodes, lin.problem.burn_nodes[later]) - 1
        constant[at, 3:] -= lin.iterate.burns[later]
        return constant


class LiftedErrors:
    """Columns C(dv) of the burns' errors in their rows of the stacked states.

    Their derivative is a constant of the program where they are linear in the burns, else a parameter.
    Burns fall on the program's `nodes`, shape (m,). The factors begin at the state `first`, each stored
    row by row; `last` is the node of the last one.
    """

    def __init__(
        self, problem: FlybyProblem, nodes: Indices, first: int, columns: int, last: int, size: int
    ) -> None:
        shared, every = problem.shared_columns, range(problem.n_burns)
        own = [problem.columns_of_burn(i) for i in every]
        filled = np.array([np.r_[shared, own[i]] for i in every], dtype=np.intp)[:, None]
        row = (6 * nodes[:, None] + 3 + np.arange(3))[..., None]
        self._kept = np.broadcast_to(
            (filled < columns) & (nodes <= last)[:, None, None], (len(nodes), 3, filled.shape[-1])
        )
        self._rows = (first + row * columns + filled)[self._kept]
        self._size, self._burns = size, problem.n_burns
        # Where no factor is carried, nothing is to be said of its derivative.
        self.affine = problem.execution_errors.affine or not self._kept.any()

    @property
    def places(self) -> tuple[Indices, Indices]:
        """Rows of the states, and burn components, that derivatives connect, in their order."""
        by = 3 * np.arange(self._burns)[:, None, None, None] + np.arange(3)
        by = np.broadcast_to(by, (*self._kept.shape, 3))[self._kept]
        return np.repeat(self._rows, 3), by.ravel()

    def derivative(self, problem: FlybyProblem, burns: Array) -> Array:
        """By the burns (m, 3), at `places`."""
        return problem.execution_errors.jacobian(burns)[self._kept].ravel()

    def constant(self, problem: FlybyProblem) -> sp.csr_array:
        """The derivative where it is the same everywhere, shape (states, 3 m)."""
        values, (rows, columns) = self.derivative(problem, np.zeros((self._burns, 3))), self.places
        filled = values != 0.0
        entries = values[filled], (rows[filled], columns[filled])
        return sp.csr_array(entries, shape=(self._size, 3 * self._burns))

    def remainder(self, problem: FlybyProblem, iterate: Iterate) -> Array:
        """Columns C less their derivative times the burns, shape (states,)."""
        errors, burns = problem.execution_errors, iterate.burns
        left = errors.columns(burns) - np.einsum("mikl,ml->mik", errors.jacobian(burns), burns)
        state = np.zeros(self._size)
        state[self._rows] = left[self._kept]
        return state


@dataclass(frozen=True)
class ComposedArcs:
    """Arcs between chosen nodes, composed from the grid's, as maps of the deviation d at their start.

    Deviation of the mean at the end: stm d + shift. STM along the deviated mean:
    stm + shift_stm + tensor . d. Shapes: (n, 6, 6), (n, 6), (n, 6, 6), (n, 6, 6, 6).
    """

    stm: Array
    shift: Array
    shift_stm: Array
    tensor: Array


def compose(lin: Linearisation, nodes: Indices) -> ComposedArcs:
    """Compose the arcs between consecutive `nodes`, which must contain every burn's node.

    With A, T, d of the next arc, D the deviation so far and P the STM so far,
    D' = A D + d and dP' = A dP + (T . D) P: the product rule, once for the part that the starting
    deviation causes (tensor) and once for the part that the defects cause (shift_stm).

    Raises:
        LinearisationError: if they are not finite.
    """
    n = len(nodes) - 1
    composed = ComposedArcs(
        np.empty((n, 6, 6)), np.empty((n, 6)), np.empty((n, 6, 6)), np.empty((n, 6, 6, 6))
    )
    defects = lin.defects
    for arc, (first, last) in enumerate(itertools.pairwise(nodes)):
        stm, shift = np.eye(6), np.zeros(6)
        shift_stm, tensor = np.zeros((6, 6)), np.zeros((6, 6, 6))
        for k in range(first, last):
            a, t = lin.arcs.stm[k], lin.arcs.tensor[k]
            shift_stm = a @ shift_stm + (t @ shift) @ stm
            # (T . stm d) stm: rows i, columns c of the STM, component l of d.
            tensor = (a @ tensor.reshape(6, 36)).reshape(6, 6, 6) + stm.T @ (t @ stm)
            stm, shift = a @ stm, a @ shift + defects[k]
        composed.stm[arc], composed.shift[arc] = stm, shift
        composed.shift_stm[arc], composed.tensor[arc] = shift_stm, tensor
    require_finite(composed.stm, composed.shift, composed.shift_stm, composed.tensor)
    return composed


def keep_out_values(rows: Rows, lin: Linearisation) -> Values:
    """The supporting planes of keep-out sets at an iterate, where the rows are deterministic."""
    values: Values = {}
    if isinstance(rows, DeterministicRows):
        for c in rows.problem.constraints:
            if c.keep == "out":
                planes = c.region.supporting(lin.iterate.mean[c.nodes, :3])
                values |= {f"{c.name} normal": planes.normal, f"{c.name} offset": planes.offset}
    return values


def _chance_rows(rows: ChanceRows, outputs: cp.Expression) -> list[cp.Expression]:
    """All facets at once; normals, offsets and quantiles are constants."""
    if rows.count == 0:
        return []
    room = rows.carried.offset - rows.pick @ outputs[:, 0]
    weighted = sp.diags_array(rows.carried.quantile) @ rows.pick
    return [cp.hstack([cp.reshape(room, (rows.count, 1), order="C"), weighted @ outputs[:, 1:]])]


def _deterministic_rows(
    rows: DeterministicRows, outputs: cp.Expression
) -> tuple[list[cp.Expression], dict[str, cp.Parameter]]:
    """One second-order cone per keep-in node, one linear row per keep-out node."""
    written: list[cp.Expression] = []
    parameters: dict[str, cp.Parameter] = {}
    for c in rows.problem.constraints:
        first = 3 * np.searchsorted(rows.nodes, c.nodes)
        picked = (first[:, None] + np.arange(3)).ravel()
        indices, shape = (np.arange(len(picked)), picked), (len(picked), outputs.shape[0])
        pick = sp.csr_array((np.ones(len(picked)), indices), shape=shape)
        position = cp.reshape(pick @ outputs[:, 0], (len(c.nodes), 3), order="C")
        if c.keep == "in":
            written.append(_keep_in(c, position))
            continue
        normal, offset = cp.Parameter(position.shape), cp.Parameter(len(c.nodes))
        parameters |= {f"{c.name} normal": normal, f"{c.name} offset": offset}
        room = cp.sum(cp.multiply(normal, position), axis=1) - offset
        written.append(cp.reshape(room, (len(c.nodes), 1), order="C"))
    return written, parameters


def _keep_in(constraint: StateConstraint, position: cp.Expression) -> cp.Expression:
    cone = constraint.region.second_order_cone
    n = len(constraint.nodes)
    offset = position - cone.origin
    blocks = sp.block_diag(list(cone.matrix), format="csr")
    across = cp.reshape(blocks @ cp.reshape(offset, (3 * n,), order="C"), (n, 3), order="C")
    along = cp.sum(cp.multiply(cone.linear, offset), axis=1) + cone.constant
    return cp.hstack([cp.reshape(along, (n, 1), order="C"), across])
