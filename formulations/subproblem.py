"""One convex subproblem: burns, dynamics, state constraints, trust region and penalty.

    min  sum ||dv_i|| + w (sum of buffers + ||virtual control||_1)

or with another charge for violations and steps, see `penalty`. Compiled once; an iteration only sets
parameters. The merit that it predicts is that of `Subproblem.merit`, evaluated there from the
nonlinear dynamics.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol

import cvxpy as cp
import numpy as np

from formulations import conic
from formulations.condensed import Condensed
from formulations.frozen_covariance import FrozenCovariance
from formulations.frozen_stm import FrozenStm
from formulations.lifted import Lifted
from formulations.lifting import Linearisation, LinearisationError
from formulations.penalty import PENALTIES, Charge, augmented_value, exact_value
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
        """What the linearised dynamics miss of the final state, shape (6,)."""
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


SMALL_BURN = 1e-2
"""Of `dv_max`; see `Subproblem.solve`."""


class SubproblemError(RuntimeError):
    """There is no usable answer; the message says why, in the conic solver's words if it has any."""


@dataclass(frozen=True)
class Step:
    """Answer of a subproblem: new burns (m, 3), the merit its model predicts, solver's seconds.

    Whether it is `accurate` is the solver's own word; a verdict needs an accurate answer.
    """

    burns: Array
    merit: float
    solver_s: float
    canonicalise_s: float
    accurate: bool = True


class Subproblem:
    """A formulation of P3 or P2 around an iterate.

    Args:
        problem: the flyby problem.
        rows: its state constraints, those of P3 or of P2.
        formulation: a key of `FORMULATIONS`.
        solver: name of a CVXPY conic solver.
        penalty: a key of `penalty.PENALTIES`.
    """

    def __init__(
        self,
        problem: FlybyProblem,
        rows: Rows,
        formulation: str,
        solver: str = "CLARABEL",
        penalty: str = "exact",
    ) -> None:
        m = problem.n_burns
        self.problem, self.rows, self._solver = problem, rows, solver
        self._burns = cp.Variable((m, 3))
        self._reference = cp.Parameter((m, 3))
        self._radius = cp.Parameter(nonneg=True)
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
        violations = cp.hstack([size_buffer, cp.vec(cone_buffers, order="C"), buffers])
        self._penalty = PENALTIES[penalty](step, self._model.virtual_control, violations)
        objective = cp.sum(size) + self._penalty.expression
        constraints += self._penalty.constraints
        self.program = cp.Problem(cp.Minimize(objective), constraints)

    def merit(self, lin: Linearisation, charge: float | Charge) -> float:
        """Total delta-v plus the charge for every violation, from the nonlinear dynamics.

        A number is the exact penalty's weight.
        """
        if isinstance(charge, Charge) and charge.multipliers is not None:
            excess = self.excess(lin)
            charged = np.r_[excess[:6], np.maximum(excess[6:], 0.0)]
            return lin.iterate.total_dv + augmented_value(charged, charge)
        weight = charge.weight if isinstance(charge, Charge) else charge
        violations = self.violations(lin)
        defects = violations.pop("dynamics")
        rows = np.concatenate(list(violations.values()))
        return lin.iterate.total_dv + exact_value(defects, rows, weight)

    def excess(self, lin: Linearisation) -> Array:
        """Miss of the final state and every row's signed violation, shape (6 + rows,).

        In the order of `violations`; a row is satisfied where it is not positive.
        """
        signed = self._signed(lin)
        del signed["dynamics"]
        return np.concatenate([lin.defects[-1], *signed.values()])

    def margins(self, lin: Linearisation) -> dict[str, Margins]:
        """Margins of the burn limits and of the state constraints by name."""
        burns = lin.problem.burn_margins(lin.iterate.burns)
        by_burn = {name: Margins(lin.problem.burn_nodes, m) for name, m in burns.items()}
        return by_burn | self.rows.margins(lin)

    def violations(self, lin: Linearisation) -> dict[str, Array]:
        """What the buffers would have to hold, by constraint name; the defects are `dynamics`."""
        return {name: np.maximum(amount, 0.0) for name, amount in self._signed(lin).items()}

    def _signed(self, lin: Linearisation) -> dict[str, Array]:
        """Violations, negative where there is room; defects by their size."""
        burns = lin.iterate.burns
        toward, away = (cone.inside(burns) for cone in lin.problem.burn_cones())
        amounts = {
            "dynamics": np.abs(lin.defects).ravel(),
            "dv_max": -lin.problem.burn_margins(burns)["dv_max"],
            "dv_battery": np.concatenate([toward, away]),
        }
        return amounts | {name: -row.margin for name, row in self.rows.margins(lin).items()}

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

    def solve(self, radius: float, charge: float | Charge) -> Step:
        """Solve within a trust region: no component of a burn moves by more than `radius`.

        Args:
            radius: of the trust region.
            charge: of the penalty; a number is the exact penalty's weight.

        Returns:
            The step, whose merit leaves out what a proximal penalty charges for it.

        Raises:
            SubproblemError: if the conic solver fails or gives no finite answer.
        """
        charge = charge if isinstance(charge, Charge) else Charge(charge)
        self._radius.value = radius
        self._penalty.set(charge)
        burns = np.asarray(self._reference.value)
        # The direction of a small burn that may turn says nothing about where it will point.
        turning = min(radius, SMALL_BURN * self.problem.dv_max)
        steady = np.linalg.norm(burns, axis=1, keepdims=True) > turning
        for parameter, cone in zip(self._cone_normals, self.problem.burn_cones(), strict=True):
            parameter.value = np.where(steady, cone.supporting(burns).normal, 0.0)
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
