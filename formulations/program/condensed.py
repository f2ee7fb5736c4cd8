"""Solve the condensed subproblem, whose only variables are burns and buffers.

The rows are second-order cones in the burns (`Rows.cones`), in a fixed number of **slots** for each
size of cone. An empty slot holds 1 >= 0, so the sparsity and the compiled program stay the same
when rows are added or removed. If slots run out, their number doubles. Rows far from binding are
left out. The answer is checked against all rows. The program is solved again with the violated rows
until no row is violated. The answer then solves the whole program.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from functools import lru_cache, partial
from time import perf_counter
from typing import NamedTuple

import cvxpy as cp
import numpy as np

from formulations.arrays import Array, Booleans, Indices
from formulations.linearisation.linearisation import (
    Condensation,
    Linearisation,
    LinearisationError,
    miss_of,
)
from formulations.problem.flyby import FlybyProblem
from formulations.program.convex_subproblem import ConvexSubproblem
from formulations.program.model import CompiledProgram, Numbers, Shape, StateModel, write_model
from formulations.program.solvers import SOLVERS, FallbackSolver
from formulations.program.subproblem import Penalty, PenaltyParameters, Step, SubproblemError
from formulations.rows.cones import Cones, Rows

SLOTS, SLOTS_WITH_GAINS = 32, 16
"""Slots for each size of cone, to begin with; with corrected burns cones are large, and few bind."""

FEW = 8
"""Violated rows per free slot up to which slots are not doubled: a kept solver solves again quickly."""

MISSED = 1e-9
"""Violation above which a row that was left out is included: the conic solver's own tolerance."""


class ConeSize(NamedTuple):
    """The size of a block of cones in a compiled program.

    `slots` cones of dimension d depend on the first p controls; for the others see `Cones`.
    """

    dimension: int
    controls: int
    triangular: bool
    slots: int
    shared: bool = False

    @property
    def entries(self) -> tuple[Indices, Indices]:
        """Rows and columns of the entries of one cone's values that can be non-zero."""
        full = np.ones((self.dimension, self.controls), dtype=np.bool_)
        if self.triangular:
            full[1:] = np.triu(full[1:])
        rows, columns = np.nonzero(full)
        return rows, columns


@lru_cache(maxsize=64)
def compile_condensed(
    shape: Shape, penalty: Penalty, sizes: tuple[ConeSize, ...]
) -> CompiledProgram:
    """Compile the program for controls of a shape and sizes of cones, once per process."""
    return CompiledProgram(write_model(shape, penalty, partial(write_states, sizes)))


def write_states(sizes: Sequence[ConeSize], controls: cp.Variable, numbers: Numbers) -> StateModel:
    """Write final state and rows as affine functions of the controls; coefficients are numbers."""
    rows = []
    miss = numbers.array("miss_jacobian", 6, controls.size) @ controls + numbers.array("miss", 6)
    for block, size in enumerate(sizes):
        row, column = size.entries
        cone = np.arange(size.slots)[:, None]
        values = numbers.matrix(
            f"values_{block}",
            (size.slots * size.dimension, size.controls),
            (cone * size.dimension + row).ravel(),
            np.tile(column, size.slots),
        )
        constants = numbers.array(f"constants_{block}", size.slots, size.dimension)
        y = cp.reshape(values @ controls[: size.controls], constants.shape, order="C") + constants
        rows.append(y)
    return StateModel(miss, rows, [], [size.shared for size in sizes])


class CondensedSubproblem(ConvexSubproblem):
    """A condensed formulation of P3 or P2 around an iterate."""

    def __init__(
        self,
        problem: FlybyProblem,
        rows: Rows,
        penalty: Penalty,
        solver: str,
        condensation: Condensation,
    ) -> None:
        super().__init__(problem, rows, penalty, FallbackSolver(solver))
        self._condense, self._name = condensation, solver
        self._reserve = FEW if solver in SOLVERS else 1
        self._active = np.zeros(rows.count, dtype=np.bool_)
        self._slots: list[int] = []
        self._cones: list[Cones] = []

    def update(self, lin: Linearisation) -> None:
        """Convexify at an iterate, once, but for bundles, which grow. Raises as in `Subproblem`."""
        known = getattr(self, "_at", None) is lin
        if not known or any(cones.shared for cones in self._cones):
            try:
                s = self._condense(lin, self.rows.nodes, factor=self.rows.condensed)
            except LinearisationError as error:
                raise SubproblemError(str(error)) from error
            self._at, self._cones = lin, self.rows.cones(lin, s)
        constant, jacobian = miss_of(lin)
        self._final = {"miss_jacobian": jacobian, "miss": constant}
        most = SLOTS if lin.problem.feedback is None else SLOTS_WITH_GAINS
        self._slots = self._slots or [min(most, 2 * len(cones.rows)) for cones in self._cones]
        slack = self._slack(lin.controls)
        self._active[:] = False
        if self._name in SOLVERS:
            self._take_near(slack)
        else:  # it starts anew each time, and had better be asked once
            self._take(~self._active, slack)

    def _take_near(self, slack: Array) -> None:
        """Fill half of the slots with the rows nearest to binding; the answer may violate others."""
        for cones, slots in zip(self._cones, self._slots, strict=True):
            near = cones.rows[slack[cones.rows] < self.rows.near]
            self._active[near[np.argsort(slack[near])[: slots // 2]]] = True

    def _attempt(self, radius: float, charge: PenaltyParameters, planes: Array) -> Step:
        """Solve with the included rows, adding others until the answer violates none."""
        start, solver_s = perf_counter(), 0.0
        while True:
            step = self._solve_with_slots(radius, charge, planes)
            solver_s += step.solver_s
            slack = self._slack(self.problem.controls(step.burns, step.gains, step.times))
            missed = ~self._active & (slack < -MISSED)
            if not np.any(missed):
                break
            self._take(missed, slack)
        return replace(step, solver_s=solver_s, canonicalise_s=perf_counter() - start - solver_s)

    def _take(self, missed: Booleans, slack: Array) -> None:
        """Put violated rows into free slots, those with least slack first.

        Slots double until at least an eighth of these rows fit: often the others are then satisfied.
        """
        for block, cones in enumerate(self._cones):
            candidates = cones.rows[missed[cones.rows]]
            if len(candidates) == 0:
                continue
            free = self._slots[block] - int(self._active[cones.rows].sum())
            while self._reserve * free < len(candidates):
                free += self._slots[block]
                self._slots[block] *= 2
                self._solver = FallbackSolver(self._name)  # the kept one has another sparsity
            self._active[candidates[np.argsort(slack[candidates])[:free]]] = True

    def _solve_with_slots(self, radius: float, charge: PenaltyParameters, planes: Array) -> Step:
        """Solve with the included rows."""
        sizes, states, buffers = [], dict(self._final), [np.zeros(0, dtype=np.intp)]
        for block, (cones, slots) in enumerate(zip(self._cones, self._slots, strict=True)):
            chosen = np.flatnonzero(self._active[cones.rows])
            n, (_, d, p) = len(chosen), cones.values.shape
            size = ConeSize(d, p, cones.triangular, slots, cones.shared)
            row, column = size.entries
            values, constants = np.zeros((slots, len(row))), np.zeros((slots, d))
            values[:n] = cones.values[chosen][:, row, column]
            constants[:n], constants[n:, 0] = cones.constants[chosen], 1.0
            states |= {f"values_{block}": values.ravel(), f"constants_{block}": constants}
            sizes.append(size)
            own = np.r_[cones.rows[chosen], np.full(slots - n, -1)]
            buffers.append(own[:1] if cones.shared else own)
        shape = Shape.of(self.problem, floor=self._has_floor)
        compiled = compile_condensed(shape, self._penalty, tuple(sizes))
        return self._solve(compiled, radius, charge, planes, states, np.concatenate(buffers))

    def _slack(self, controls: Array) -> Array:
        """Slack of every row by the model, >= 0 where satisfied, shape (rows,)."""
        slack = np.full(self.rows.count, np.inf)
        for cones in self._cones:
            y = cones.at(controls)
            np.minimum.at(slack, cones.rows, y[:, 0] - np.linalg.norm(y[:, 1:], axis=1))
        return slack
