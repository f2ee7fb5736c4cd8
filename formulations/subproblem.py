"""One convex subproblem: burns, dynamics, state constraints, trust region and exact penalty.

    min  sum ||dv_i|| + w (sum of buffers + ||virtual control||_1)

Compiled once; an iteration only sets parameters. The merit that it predicts is that of
`Subproblem.merit`, evaluated there from the nonlinear dynamics.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable
from dataclasses import dataclass
from time import perf_counter
from typing import Protocol

import cvxpy as cp
import numpy as np

from formulations.condensed import Condensed
from formulations.frozen_covariance import FrozenCovariance
from formulations.frozen_stm import FrozenStm
from formulations.lifted import Lifted
from formulations.lifting import Linearisation, LinearisationError
from formulations.problem import FlybyProblem, Nodes
from formulations.regions import Array
from formulations.rows import Margins, Rows


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
        """One-norm of what the linearised dynamics miss."""
        ...

    def update(self, lin: Linearisation) -> None:
        """Set the parameters for an iterate."""
        ...


StateModelFactory = Callable[[FlybyProblem, cp.Variable, Nodes, bool], StateModel]

FORMULATIONS: dict[str, StateModelFactory] = {
    "condensed": Condensed,
    "lifted": Lifted,
    "frozen-stm": FrozenStm,
    "frozen-covariance": FrozenCovariance,
}


DYNAMICS_WEIGHT = 10.0
"""Of the dynamics against a constraint, so that infeasible cases violate constraints, not physics."""

SMALL_BURN = 1e-2
"""Of `dv_max`; see `Subproblem.solve`."""


TOLERANCES = dict.fromkeys(("tol_gap_abs", "tol_gap_rel", "tol_feas"), 1e-9)
"""Tighter than Clarabel's 1e-8, so that late, small predicted reductions still mean something."""


class SubproblemError(RuntimeError):
    """There is no usable answer; the message says why, in the conic solver's words if it has any."""


@dataclass(frozen=True)
class Step:
    """Answer of a subproblem: new burns (m, 3), the merit its model predicts, solver's seconds."""

    burns: Array
    merit: float
    solver_s: float
    canonicalise_s: float


class Subproblem:
    """A formulation of P3 or P2 around an iterate.

    Args:
        problem: the flyby problem.
        rows: its state constraints, those of P3 or of P2.
        formulation: a key of `FORMULATIONS`.
        solver: name of a CVXPY conic solver.
    """

    def __init__(
        self, problem: FlybyProblem, rows: Rows, formulation: str, solver: str = "CLARABEL"
    ) -> None:
        m = problem.n_burns
        self.problem, self.rows, self._solver = problem, rows, solver
        self._burns = cp.Variable((m, 3))
        self._reference = cp.Parameter((m, 3))
        self._radius = cp.Parameter(nonneg=True)
        self._weight = cp.Parameter(nonneg=True)
        self._model = FORMULATIONS[formulation](problem, self._burns, rows.nodes, rows.with_factor)
        size_buffer, cone_buffers = cp.Variable(m, nonneg=True), cp.Variable((2, m), nonneg=True)
        self._cone_normals = [cp.Parameter((m, 3)) for _ in range(2)]
        size = cp.norm(self._burns, axis=1)
        state_rows, buffers = rows.build(self._model.outputs)
        step = self._burns - self._reference
        constraints = [
            *self._model.constraints,
            *state_rows,
            step <= self._radius,
            -step <= self._radius,
            size <= problem.dv_max + size_buffer,
            *(
                cp.sum(cp.multiply(normal, self._burns), axis=1) >= -cone_buffers[i]
                for i, normal in enumerate(self._cone_normals)
            ),
        ]
        penalty = (
            DYNAMICS_WEIGHT * self._model.virtual_control
            + buffers
            + cp.sum(size_buffer)
            + cp.sum(cone_buffers)
        )
        objective = cp.sum(size) + self._weight * penalty
        self.program = cp.Problem(cp.Minimize(objective), constraints)

    def merit(self, lin: Linearisation, weight: float) -> float:
        """Total delta-v plus `weight` times every violation, from the nonlinear dynamics."""
        violations = self.violations(lin)
        violation = DYNAMICS_WEIGHT * violations.pop("dynamics").sum()
        violation += sum(float(v.sum()) for v in violations.values())
        return lin.iterate.total_dv + weight * violation

    def margins(self, lin: Linearisation) -> dict[str, Margins]:
        """Margins of the burn limits and of the state constraints by name."""
        burns = lin.problem.burn_margins(lin.iterate.burns)
        by_burn = {name: Margins(lin.problem.burn_nodes, m) for name, m in burns.items()}
        return by_burn | self.rows.margins(lin)

    def violations(self, lin: Linearisation) -> dict[str, Array]:
        """What the buffers would have to hold, by constraint name; the defects are `dynamics`."""
        burns = lin.problem.burn_margins(lin.iterate.burns)
        toward, away = (cone.inside(lin.iterate.burns) for cone in lin.problem.burn_cones())
        amounts = {
            "dynamics": np.abs(lin.defects).ravel(),
            "dv_max": np.maximum(-burns["dv_max"], 0.0),
            "dv_battery": np.maximum(np.concatenate([toward, away]), 0.0),
        }
        rows = self.rows.margins(lin).items()
        return amounts | {name: np.maximum(-row.margin, 0.0) for name, row in rows}

    def update(self, lin: Linearisation) -> None:
        """Set every parameter for an iterate.

        Raises:
            SubproblemError: if the dynamics cannot be linearised there.
        """
        self._reference.value = lin.iterate.burns
        try:
            self._model.update(lin)
        except LinearisationError as error:
            raise SubproblemError(str(error)) from error
        self.rows.update(lin)

    def solve(self, radius: float, weight: float) -> Step:
        """Solve within a trust region: no component of a burn moves by more than `radius`.

        Raises:
            SubproblemError: if the conic solver fails or gives no finite answer.
        """
        self._radius.value, self._weight.value = radius, weight
        burns = np.asarray(self._reference.value)
        # The direction of a small burn that may turn says nothing about where it will point.
        turning = min(radius, SMALL_BURN * self.problem.dv_max)
        steady = np.linalg.norm(burns, axis=1, keepdims=True) > turning
        for parameter, cone in zip(self._cone_normals, self.problem.burn_cones(), strict=True):
            parameter.value = np.where(steady, cone.supporting(burns).normal, 0.0)
        settings = TOLERANCES | self._model.clarabel if self._solver == "CLARABEL" else {}
        start = perf_counter()
        try:
            # An inaccurate answer is judged by the ratio test, not by a warning on the terminal.
            with warnings.catch_warnings():
                warnings.filterwarnings("ignore", message="Solution may be inaccurate")
                # CVXPY's own canonicalisation of sparse parameters trips over its own advice.
                warnings.filterwarnings("ignore", message="Reading from a sparse CVXPY expression")
                merit = self.program.solve(solver=self._solver, canon_backend="COO", **settings)
        except cp.SolverError as error:
            raise SubproblemError(str(error)) from error
        burns = self._burns.value
        if burns is None or not np.all(np.isfinite(burns)):
            raise SubproblemError(f"{self._solver} ended with status {self.program.status}")
        solver_s = self.program.solver_stats.solve_time or 0.0
        return Step(burns, float(merit), solver_s, perf_counter() - start - solver_s)
