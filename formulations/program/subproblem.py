"""The convex subproblem of an iteration: burns, dynamics, state constraints, trust region, penalty.

    min  cost + w (sum of buffers + ||virtual control||_1)

or with another charge for violations and steps. The violations v >= 0 are the buffers in the order
of `MeritFunction.violations`, the miss m of the final state is signed, the step s is that of the
burns:

    exact      w (10 ||m||_1 + sum v)
    proximal   w (10 ||m||_1 + sum v) + p/2 ||s||^2
    augmented  l'(m, v) + w/2 ||(m, v)||^2
    least      10 ||m||_1 + sum v, in place of the cost
    bounded    nothing, as long as 10 ||m||_1 + sum v is at most a budget.

The merit of an iterate is its cost plus its charges. It always uses the nonlinear dynamics, never
the model. The program is written in `model`; the formulations in `condensed` and `lifted`.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass, field
from typing import Literal

import numpy as np

from formulations.arrays import Array
from formulations.linearisation.linearisation import Linearisation, Seen
from formulations.problem.flyby import NO_GAINS, NO_TIMES, FlybyProblem
from formulations.rows.cones import Margins, Rows

Penalty = Literal["exact", "proximal", "augmented", "least", "bounded"]

DYNAMICS_WEIGHT = 10.0
"""Weight of the dynamics over constraints, so that infeasible cases violate those, not physics."""


@dataclass(frozen=True)
class PenaltyParameters:
    """Charges of an iteration: weight w of violations, and p of the step if proximal.

    If augmented, multipliers of (m, v) have shape (6 + rows,). With "least" the weight is one and
    nothing else is charged. With "bounded" the model's violations sum up to `budget` at most; those of
    a flown iterate are charged above it, and none may be above `allowed`.
    """

    weight: float
    prox: float = 0.0
    multipliers: Array | None = None
    least: bool = False
    budget: float | None = None
    allowed: float = 0.0


class MeritFunction:
    """Cost and violations of an iterate.

    Boundary states and initial covariance are those of the linearisation's problem, so that one
    function serves flights from any initial state. Limits and constraints are this problem's.
    Grid, burn nodes and execution errors must be the same in both.
    """

    def __init__(self, problem: FlybyProblem, rows: Rows) -> None:
        self.problem, self.rows = problem, rows
        self._seen = Seen[dict[str, Array]]()

    def __call__(self, lin: Linearisation, charge: float | PenaltyParameters) -> float:
        """Total delta-v plus the charge for every violation, from the nonlinear dynamics.

        If the final state need not be met, its weighed miss is part of the cost, and no violation.
        A number as `charge` is the exact penalty's weight.
        """
        if isinstance(charge, PenaltyParameters) and charge.multipliers is not None:
            excess = self.excess(lin)
            charged = np.r_[excess[:6], np.maximum(excess[6:], 0.0)]
            value = charge.multipliers @ charged + 0.5 * charge.weight * (charged @ charged)
            return self.cost(lin) + float(value)
        charge = charge if isinstance(charge, PenaltyParameters) else PenaltyParameters(charge)
        if charge.least:
            return self.violated(lin)
        miss = (self.problem.miss_weight or 0.0) * float(np.abs(lin.defects[-1]).sum())
        cost = self.cost(lin) + miss
        if charge.budget is not None:
            over = max(self.violated(lin) - charge.budget, 0.0)
            allowed = self.worst_violation(lin) <= charge.allowed
            return cost + charge.weight * over if allowed else np.inf
        return cost + charge.weight * self.violated(lin)

    def violated(self, lin: Linearisation) -> float:
        """The sum of all violations, those of the dynamics with their weight."""
        violations = self.violations(lin)
        defects = violations.pop("dynamics")
        rows = np.concatenate(list(violations.values()))
        return float(DYNAMICS_WEIGHT * defects.sum() + rows.sum())

    def cost(self, lin: Linearisation) -> float:
        """The total delta-v, as the problem counts it."""
        return lin.cost.value

    def excess(self, lin: Linearisation) -> Array:
        """Miss of the final state and every row's signed violation, shape (6 + rows,).

        In the order of `violations`; a row is satisfied where it is not positive.
        """
        signed = dict(self._signed(lin))
        del signed["dynamics"]
        return np.concatenate([lin.defects[-1], *signed.values()])

    def margins(self, lin: Linearisation) -> dict[str, Margins]:
        """Margins of the burn limits and of the state constraints by name; a burn of zero has none."""
        fired = lin.iterate.burns.any(axis=1)
        burns, nodes = self.problem.burn_margins(lin.iterate.burns), self.problem.burn_nodes
        by_burn = {name: Margins(nodes[fired], m[fired]) for name, m in burns.items()}
        return (by_burn if fired.any() else {}) | self.rows.margins(lin)

    def violations(self, lin: Linearisation) -> dict[str, Array]:
        """Violations >= 0 by constraint, in the order of the buffers; the defects are `dynamics`."""
        return {name: np.maximum(amount, 0.0) for name, amount in self._signed(lin).items()}

    def worst_violation(self, lin: Linearisation) -> float:
        """The largest of all violations and defects."""
        return max(float(amount.max(initial=0.0)) for amount in self.violations(lin).values())

    def _signed(self, lin: Linearisation) -> dict[str, Array]:
        """Signed violations, negative where there is slack; defects by their size."""
        if lin not in self._seen:
            burns = lin.iterate.burns
            toward, away = (cone.inside(burns) for cone in self.problem.burn_cones)
            defects = lin.defects if self.problem.miss_weight is None else lin.defects[:-1]
            amounts = {
                "dynamics": np.abs(defects).ravel(),
                "dv_max": -self.problem.burn_margins(burns)["dv_max"],
                "dv_battery": np.concatenate([toward, away]),
            }
            rows = self.rows.margins(lin).items()
            self._seen[lin] = amounts | {name: -row.margin for name, row in rows}
        return self._seen[lin]


class SubproblemError(RuntimeError):
    """A subproblem without a usable answer; the message gives the conic solver's reason if any."""


@dataclass(frozen=True)
class Step:
    """Answer of a subproblem: burns (m, 3), gains and firing times, the merit by its model, seconds.

    `accurate` if the conic solver reports so; a verdict needs an accurate answer.
    """

    burns: Array
    merit: float
    solver_s: float
    canonicalise_s: float
    accurate: bool = True
    gains: Array = field(default_factory=NO_GAINS.copy)
    times: Array = field(default_factory=NO_TIMES.copy)


class Subproblem(ABC):
    """A formulation of P3 or P2 around an iterate, which approximates `merit`.

    `MeritFunction` says which data come from the problem of the linearisation, and which from its own.
    """

    merit: MeritFunction

    @abstractmethod
    def update(self, lin: Linearisation) -> None:
        """Convexify at an iterate.

        Raises:
            SubproblemError: if the dynamics cannot be linearised there.
        """

    @abstractmethod
    def solve(self, radius: float, charge: float | PenaltyParameters) -> Step:
        """Solve within a trust region: no component of a burn, no gain moves by more than `radius`.

        Nor does a firing time or phase move by more than `radius` times `controls.UNIT`.
        A number as `charge` is the exact penalty's weight. The step's merit leaves out a proximal
        penalty's charge.

        Raises:
            SubproblemError: if the conic solver fails or gives no finite answer.
        """
