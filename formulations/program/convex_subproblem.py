"""Base of all formulations: set parameters, evaluate the compiled program, solve, and read back."""

from __future__ import annotations

from abc import abstractmethod
from dataclasses import replace
from time import perf_counter

import numpy as np

from formulations.arrays import Array, Indices
from formulations.linearisation.linearisation import Linearisation
from formulations.problem.controls import UNIT
from formulations.problem.flyby import FlybyProblem
from formulations.program.model import CompiledProgram, Values, cost_values, penalty_values
from formulations.program.solvers import GAP, FallbackSolver
from formulations.program.subproblem import (
    MeritFunction,
    Penalty,
    PenaltyParameters,
    Step,
    Subproblem,
    SubproblemError,
)
from formulations.rows.cones import Rows

SMALL_BURN = 1e-2
"""Size of a small burn over `dv_max`; see `ConvexSubproblem.solve`."""

LEAST_GAP = 1e-8
"""Largest relative error in the proof of a least violation: a hundredth of what counts as none."""

INSIDE = 1e-9
"""Depth in a cone that is ignored: the conic solver's own tolerance."""

HELD = 1e-9
"""Trust radius of a burn that is held: a set with an interior, as conic solvers want it, in which no
model can promise anything. With 1e-7 PTR stalled where with this it converges."""


class ConvexSubproblem(Subproblem):
    """A subproblem whose program is a `CompiledProgram`, convexified by `update`.

    The solver is kept from iteration to iteration.
    """

    def __init__(
        self, problem: FlybyProblem, rows: Rows, penalty: Penalty, solver: FallbackSolver
    ) -> None:
        self.merit, self.problem, self.rows = MeritFunction(problem, rows), problem, rows
        self._penalty, self._solver = penalty, solver
        self._at: Linearisation
        self._had_floor = False

    def solve(self, radius: float, charge: float | PenaltyParameters) -> Step:
        """See `Subproblem.solve`.

        Planes keep burns out of the battery's cones, one for each nappe. The present direction of a
        small burn says little about its next direction. The program is therefore solved without
        planes first. The answer gives a direction, and a bound on the merit for any direction. If
        the answer lies in a cone, the program is solved with planes towards the answer and with
        planes towards the present direction, and the better answer counts. The second one is no
        worse than no step. From a guess there is no step to compare with, and the first one counts.
        """
        charge = charge if isinstance(charge, PenaltyParameters) else PenaltyParameters(charge)
        burns = self._at.iterate.burns
        planes = self.burn_planes(burns)
        small = np.linalg.norm(burns, axis=1) <= min(radius, SMALL_BURN * self.problem.dv_max)
        if not small.any():
            return self._attempt(radius, charge, planes)
        which = small[:, None]
        free = self._attempt(radius, charge, np.where(which, 0.0, planes))
        toward, away = (cone.inside(free.burns) for cone in self.problem.burn_cones)
        if np.maximum(toward, away)[small].max() <= INSIDE or not self._at.is_dynamically_feasible:
            return free
        turned = self.burn_planes(np.where(which, free.burns, burns))
        steps = [free, *(self._attempt(radius, charge, either) for either in (turned, planes))]
        return replace(
            min(steps[1:], key=lambda step: step.merit),
            solver_s=sum(step.solver_s for step in steps),
            canonicalise_s=sum(step.canonicalise_s for step in steps),
        )

    @abstractmethod
    def _attempt(self, radius: float, charge: PenaltyParameters, planes: Array) -> Step:
        """Solve with the normals of some planes off the battery's cones, shape (2, m, 3)."""

    def burn_planes(self, burns: Array) -> Array:
        """Normals of the planes that keep burns out of the battery's cones, shape (2, m, 3).

        For any unit vector e across the Sun line, ||across|| >= e'dv. The violation of a plane is
        therefore never less than that of its cone. At these burns the two are equal.
        """
        if not self.problem.dv_cone:
            return np.zeros((2, *burns.shape))
        toward, away = self.problem.burn_cones
        across = toward.across(burns)
        return np.stack([cone.facets(across, cone.half_angle).normal for cone in (toward, away)])

    @property
    def _has_floor(self) -> bool:
        """Whether some burns are raised."""
        return bool(self._at.problem.raised)

    def _floor(self, burns: Array) -> Values:
        """Planes that keep raised burns at their least size or above, at the burns' own directions."""
        normals, floor = np.zeros(burns.shape), np.full(len(burns), -1.0)
        for i in self._at.problem.raised:
            normals[i] = burns[i] / np.linalg.norm(burns[i])
            floor[i] = self._at.problem.dv_min
        return {"floor_normals": normals, "floor": floor}

    def _solve(
        self,
        compiled: CompiledProgram,
        radius: float,
        charge: PenaltyParameters,
        planes: Array,
        states: Values,
        buffers: Indices,
    ) -> Step:
        """Solve with an iteration's numbers; `buffers` holds the row of each buffer, -1 for none."""
        start, burns = perf_counter(), self._at.iterate.burns
        controls = self._at.controls
        if self._has_floor != self._had_floor:  # the kept solver has another sparsity
            self._solver.forget()
            self._had_floor = self._has_floor
        bounds, held = np.full(controls.shape, radius), list(self._at.problem.held)
        still = self.problem.controls_of(held)
        bounds[still] = min(radius, HELD)
        own = {
            "centre": controls,
            "radius": bounds,
            "dv_max": np.array(self.problem.dv_max),
            "cone_normals": planes.reshape(-1, 3),
        }
        if self._has_floor:
            own |= self._floor(burns)
        of_cost, left = ({}, 0.0) if charge.least else cost_values(self._at)
        firing, weight = self._at.problem.firing, self.problem.miss_weight
        if firing is not None and firing.names:
            own |= {"rules": UNIT * firing.matrix, "rules_least": firing.least}
        prices = penalty_values(self._penalty, charge, len(burns), buffers, weight)
        program = compiled.evaluate(own | of_cost | prices | states)
        try:
            answer = self._solver.solve(program, LEAST_GAP if charge.least else GAP)
        except ValueError as error:
            raise SubproblemError(str(error)) from error
        moved, merit = compiled.controls(answer.x), left + float(program.cost @ answer.x)
        moved[still] = controls[still]
        if self._penalty == "proximal":
            merit -= 0.5 * charge.prox * float(((moved - controls) ** 2).sum())
        spent = perf_counter() - start
        return Step(
            moved[self.problem.burn_controls],
            merit,
            answer.solver_s,
            spent - answer.solver_s,
            answer.accurate,
            moved[self.problem.gain_controls],
            UNIT * moved[self.problem.time_controls],
        )
