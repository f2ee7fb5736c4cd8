"""The convex program around an iterate, in CVXPY.

    min   sum t + prices'(a, v) + curvature s
    s.t.  ||z_i|| <= t_i                                 size of each burn
          -radius <= z - centre <= radius                trust region
          t <= dv_max + v_size                           largest burn
          n'z_i + v_cone >= 0                            planes that keep burns off the battery's cones
          |miss| <= a  or  miss = a                      virtual control of the final state
          y_0 + v_row >= ||(y_1, ...)||                  state constraints, P3's or P2's
          v >= 0

with the burns z, and in s the sum of squares that a penalty charges, if it does: as a cone, because a
quadratic objective keeps the solvers short of their tolerances. How the miss and the rows y follow from
the burns is a formulation's own: see `condensed` and `lifted`. Whatever changes from iteration to
iteration is a parameter, so that the program is compiled once.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass

import cvxpy as cp
import numpy as np
import scipy.sparse as sp

from formulations.problem.flyby import Nodes
from formulations.problem.regions import Array
from formulations.program.penalty import DYNAMICS_WEIGHT, Penalty, PenaltyParameters

Values = dict[str, Array]
"""Numbers by a parameter's name."""


@dataclass(frozen=True)
class StateModel:
    """What one formulation makes of the burns.

    Attributes:
        miss: of the final state, shape (6,).
        rows: the y of the state constraints, shape (n, d) for n cones of dimension d; their buffers are
            in this order.
        constraints: the linearised dynamics, where they are not eliminated.
        parameters: by name.
    """

    miss: cp.Expression
    rows: list[cp.Expression]
    constraints: list[cp.Constraint]
    parameters: Mapping[str, cp.Parameter]


StateModelWriter = Callable[[cp.Variable], StateModel]
"""From all burns stacked, shape (3 m,)."""


@dataclass(frozen=True)
class Model:
    """The program and what is read from it and set in it by name."""

    program: cp.Problem
    burns: cp.Variable
    parameters: Mapping[str, cp.Parameter]


def write_model(n_burns: int, penalty: Penalty, write_states: StateModelWriter) -> Model:
    """Write the program with one formulation's states and one penalty."""
    m = n_burns
    z, size, squares = cp.Variable(3 * m), cp.Variable(m), cp.Variable()
    states = write_states(z)
    n_rows = sum(rows.shape[0] for rows in states.rows)
    excess, violation = cp.Variable(6), cp.Variable(3 * m + n_rows)
    charged = cp.hstack([excess, violation])
    own = {
        "centre": cp.Parameter(3 * m),
        "radius": cp.Parameter(),
        "dv_max": cp.Parameter(),
        "cone_normals": cp.Parameter((2 * m, 3)),
        "prices": cp.Parameter(6 + 3 * m + n_rows),
        "curvature": cp.Parameter(),
    }
    step, burns = z - own["centre"], cp.reshape(z, (m, 3), order="C")
    constraints = [
        *states.constraints,
        cp.SOC(size, burns, axis=1),
        step <= own["radius"],
        -step <= own["radius"],
        size <= own["dv_max"] + violation[:m],
        cp.sum(cp.multiply(own["cone_normals"], cp.vstack([burns, burns])), axis=1)
        + violation[m : 3 * m]
        >= 0,
        violation >= 0,
    ]
    first = 3 * m
    for y in states.rows:
        buffer = violation[first : first + y.shape[0]]
        first += y.shape[0]
        constraints.append(
            cp.SOC(y[:, 0] + buffer, y[:, 1:], axis=1) if y.shape[1] > 1 else y[:, 0] + buffer >= 0
        )
    if penalty == "augmented":
        constraints.append(states.miss == excess)
    else:
        constraints += [states.miss <= excess, -states.miss <= excess]
    objective = cp.sum(size) + own["prices"] @ charged
    if penalty == "exact":
        del own["curvature"]
    else:
        objective += own["curvature"] * squares
        constraints.append(cp.sum_squares(step if penalty == "proximal" else charged) <= squares)
    parameters = {**own, **states.parameters}
    return Model(cp.Problem(cp.Minimize(objective), constraints), z, parameters)


def penalty_values(
    penalty: Penalty,
    charge: PenaltyParameters,
    n_burns: int,
    rows: Nodes,
    miss_weight: float | None = None,
) -> Values:
    """What prices and curvature are for a charge.

    Args:
        penalty: of the model.
        charge: of this iteration.
        n_burns: m.
        rows: row of the constraints that each buffer belongs to, -1 for none; shape (buffers,).
        miss_weight: see `FlybyProblem`; not with the penalty "augmented".
    """
    limits = 6 + 3 * n_burns
    prices = np.full(limits + len(rows), charge.weight)
    if penalty == "augmented":
        assert charge.multipliers is not None
        prices[:limits] = charge.multipliers[:limits]
        prices[limits:] = np.where(rows < 0, 0.0, charge.multipliers[limits:][rows])
        return {"prices": prices, "curvature": np.array(0.5 * charge.weight)}
    prices[:6] = charge.weight * DYNAMICS_WEIGHT if miss_weight is None else miss_weight
    if penalty == "proximal":
        return {"prices": prices, "curvature": np.array(0.5 * charge.prox)}
    return {"prices": prices}


def sparse_parameter(
    shape: tuple[int, int], rows: Nodes, columns: Nodes
) -> tuple[cp.Parameter, cp.Expression]:
    """A parameter of a matrix's entries at given places, and that matrix.

    As a constant sparse map of a vector, which compiles faster than CVXPY's own sparse parameters.
    """
    entries, n = cp.Parameter(len(rows)), len(rows)
    places = (rows + shape[0] * columns, np.arange(n))
    spread = sp.csr_array((np.ones(n), places), shape=(shape[0] * shape[1], n))
    return entries, cp.reshape(spread @ entries, shape, order="F")
