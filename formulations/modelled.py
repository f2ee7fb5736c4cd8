"""A subproblem written in CVXPY: any formulation, penalty, and conic solver that CVXPY finds.

Compiled once; an iteration only sets parameters.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Protocol

import cvxpy as cp
import numpy as np

from formulations import conic
from formulations.condensations import CONDENSATIONS
from formulations.condensed import Condensed
from formulations.lifted import Lifted
from formulations.lifting import Linearisation, LinearisationError
from formulations.modelled_penalty import PENALTIES
from formulations.modelled_rows import model_rows
from formulations.penalty import Charge, Penalty
from formulations.problem import FlybyProblem, Nodes
from formulations.rows import Rows
from formulations.subproblem import Step, Subproblem, SubproblemError


class StateModel(Protocol):
    """How mean and factor follow from the burns: what distinguishes one formulation from another."""

    @property
    def clarabel(self) -> dict[str, float]:
        """Clarabel's settings, where the defaults do not serve."""
        ...

    @property
    def outputs(self) -> cp.Expression:
        """Position and factor rows of the used nodes, shape (3 n, 1 + c)."""
        ...

    @property
    def constraints(self) -> list[cp.Constraint]:
        """The linearised dynamics."""
        ...

    @property
    def virtual_control(self) -> cp.Expression:
        """What the linearised dynamics miss of the final state, shape (6,)."""
        ...

    def update(self, lin: Linearisation) -> None:
        """Set the parameters for an iterate."""
        ...


StateModelFactory = Callable[[FlybyProblem, cp.Variable, Nodes, bool], StateModel]

STATE_MODELS: dict[str, StateModelFactory] = {
    "lifted": Lifted,
    **{
        name: partial(Condensed, condensation=condensation)
        for name, condensation in CONDENSATIONS.items()
    },
}


class ModelledSubproblem(Subproblem):
    """A formulation of P3 or P2 around an iterate, in CVXPY.

    Args:
        problem: the flyby problem.
        rows: its state constraints, those of P3 or of P2.
        formulation: a key of `STATE_MODELS`.
        solver: name of a CVXPY conic solver.
        penalty: how violations and steps are charged.
    """

    def __init__(
        self,
        problem: FlybyProblem,
        rows: Rows,
        formulation: str,
        solver: str = "CLARABEL",
        penalty: Penalty = "exact",
    ) -> None:
        m = problem.n_burns
        super().__init__(problem, rows)
        self._solver = solver
        self._burns = cp.Variable((m, 3))
        self._reference = cp.Parameter((m, 3))
        self._radius = cp.Parameter(nonneg=True)
        self._model = STATE_MODELS[formulation](problem, self._burns, rows.nodes, rows.with_factor)
        size_buffer, cone_buffers = cp.Variable(m, nonneg=True), cp.Variable((2, m), nonneg=True)
        self._cone_normals = [cp.Parameter((m, 3)) for _ in range(2)]
        size = cp.norm(self._burns, axis=1)
        self._rows = model_rows(rows, self._model.outputs)
        step = self._burns - self._reference
        constraints = [
            *self._model.constraints,
            *self._rows.constraints,
            step <= self._radius,
            -step <= self._radius,
            size <= problem.dv_max + size_buffer,
            *(
                cp.sum(cp.multiply(normal, self._burns), axis=1) >= -cone_buffers[i]
                for i, normal in enumerate(self._cone_normals)
            ),
        ]
        violations = cp.hstack([size_buffer, cp.vec(cone_buffers, order="C"), self._rows.buffers])
        self._penalty = PENALTIES[penalty](step, self._model.virtual_control, violations)
        objective = cp.sum(size) + self._penalty.expression
        constraints += self._penalty.constraints
        self.program = cp.Problem(cp.Minimize(objective), constraints)

    def update(self, lin: Linearisation) -> None:
        """Set every parameter for an iterate. Raises as `Subproblem.update` does."""
        self._reference.value = lin.iterate.burns
        try:
            self._model.update(lin)
        except LinearisationError as error:
            raise SubproblemError(str(error)) from error
        self._rows.update(lin)

    def solve(self, radius: float, charge: float | Charge) -> Step:
        """See `Subproblem.solve`."""
        charge = charge if isinstance(charge, Charge) else Charge(charge)
        self._radius.value = radius
        self._penalty.set(charge)
        burns = np.asarray(self._reference.value)
        for parameter, normal in zip(
            self._cone_normals, self.burn_planes(burns, radius), strict=True
        ):
            parameter.value = normal
        settings = self._model.clarabel if self._solver == "CLARABEL" else {}
        try:
            answer = conic.solve(self.program, self._solver, settings)
        except cp.SolverError as error:
            raise SubproblemError(str(error)) from error
        moved = self._burns.value
        if moved is None or not np.all(np.isfinite(moved)):
            raise SubproblemError(f"{self._solver} gave no finite burns")
        merit = answer.value - 0.5 * charge.prox * float(((moved - burns) ** 2).sum())
        return Step(moved, merit, answer.solver_s, answer.canonicalise_s, answer.accurate)
