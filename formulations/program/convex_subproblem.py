"""What all formulations share: set the parameters, evaluate the compiled program, solve, read back."""

from __future__ import annotations

from time import perf_counter

import numpy as np

from formulations.lifting import Linearisation
from formulations.penalty import Charge, Penalty
from formulations.problem import FlybyProblem, Nodes
from formulations.program.compiled import CompiledProgram
from formulations.program.model import Values, penalty_values
from formulations.program.solvers import FallbackSolver
from formulations.program.subproblem import Step, Subproblem, SubproblemError
from formulations.rows import Rows


class ConvexSubproblem(Subproblem):
    """A subproblem whose program is a `CompiledProgram`.

    Args:
        problem: the flyby problem.
        rows: its state constraints, those of P3 or of P2.
        penalty: how violations and steps are charged.
        solver: of cone programs, kept from iteration to iteration.
    """

    def __init__(
        self, problem: FlybyProblem, rows: Rows, penalty: Penalty, solver: FallbackSolver
    ) -> None:
        super().__init__(problem, rows)
        self._penalty, self._solver = penalty, solver

    def _solve(
        self,
        compiled: CompiledProgram,
        at: Linearisation,
        radius: float,
        charge: Charge,
        states: Values,
        buffers: Nodes,
    ) -> Step:
        """Solve the program with the numbers of an iteration.

        Args:
            compiled: the program.
            at: where it is convexified.
            radius: of the trust region.
            charge: of the penalty.
            states: values of what the formulation adds, by parameter.
            buffers: row that each buffer belongs to, -1 for none.

        Raises:
            SubproblemError: if there is no answer.
        """
        start, burns = perf_counter(), at.iterate.burns
        own = {
            "centre": burns.ravel(),
            "radius": np.array(radius),
            "dv_max": np.array(self.problem.dv_max),
            "cone_normals": self.burn_planes(burns, radius).reshape(-1, 3),
        }
        prices = penalty_values(self._penalty, charge, len(burns), buffers)
        program = compiled.evaluate(own | prices | states)
        try:
            answer = self._solver.solve(program)
        except ValueError as error:
            raise SubproblemError(str(error)) from error
        moved, merit = compiled.burns(answer.x), float(program.cost @ answer.x)
        if self._penalty == "proximal":
            merit -= 0.5 * charge.prox * float(((moved - burns) ** 2).sum())
        spent = perf_counter() - start
        return Step(moved, merit, answer.solver_s, spent - answer.solver_s, answer.accurate)
