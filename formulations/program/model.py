"""The convex program around an iterate: written in CVXPY, and compiled once to a cone program.

    min   sum t + prices'(a, v) + curvature s
    s.t.  ||z_i|| <= t_i                                 size of each burn
          -radius <= z - centre <= radius                trust region
          t <= dv_max + v_size                           largest burn
          n'z_i + v_cone >= 0                            planes that keep burns off the battery's cones
          d'z_i >= dv_min                                smallest burn, of those that are raised
          R t >= r                                       rules of firing times and phases
          |miss| <= a  or  miss = a                      virtual control of the final state
          y_0 + v_row >= ||(y_1, ...)||                  state constraints, P3's or P2's
          v >= 0

with the burns z, and the sum of squares s that a penalty may charge. It is written as a cone,
because the solvers do not reach their tolerances with a quadratic objective. The cone of an
augmented Lagrangian contains the root of its weight, and its curvature is 1: a weight outside the
cone would multiply the solver's tolerance. Each formulation writes the miss and the rows y as
functions of the burns: see `condensed` and `lifted`. Everything that changes between iterations is
a parameter or one of `Numbers`, so the program is compiled once.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, NamedTuple, Self

import cvxpy as cp
import numpy as np
import scipy.sparse as sp

from formulations.arrays import Array, Indices
from formulations.linearisation.linearisation import Linearisation
from formulations.problem.controls import Cost
from formulations.problem.cost import SMALLEST, formula, roots_of
from formulations.problem.flyby import FlybyProblem
from formulations.program.solvers import ConeProgram
from formulations.program.subproblem import DYNAMICS_WEIGHT, Penalty, PenaltyParameters

Values = dict[str, Array]
"""Numbers by their name."""

MARK = 2.0**40
"""Number n of `Numbers` is written as the constant MARK + n, far from any other."""


class Numbers:
    """Numbers of a program that change between iterations, other than CVXPY's parameters.

    Each number is a marked constant, which is located in the compiled form. Each must stand alone in
    its entry of A or b, not in a sum.

    Parameters of CVXPY in the place of these numbers were tried. The default plan compiles and
    evaluates in 5 to 20 ms more, but CVXPY's time grows with the entries that a parameter reaches: a
    program with gains for three corrected burns (46,000 entries) compiles in 0.4 to 1.3 s instead of
    0.05 s, one with five (137,000) in 1.7 to 2.9 s instead of 0.1 s, and a plan compiles several.

    Attributes:
        slices: of all numbers, those of each array by its name.
        size: their number.
    """

    def __init__(self) -> None:
        self.slices: dict[str, slice] = {}
        self.size = 0

    def array(self, name: str, *shape: int) -> cp.Constant:
        """A vector or matrix, its numbers in column-major order as a parameter's are."""
        return cp.Constant(np.reshape(self._marks(name, int(np.prod(shape))), shape, order="F"))

    def matrix(
        self, name: str, shape: tuple[int, int], rows: Indices, columns: Indices
    ) -> cp.Constant:
        """A sparse matrix with numbers at some places."""
        return cp.Constant(
            sp.csr_array((self._marks(name, len(rows)), (rows, columns)), shape=shape)
        )

    def _marks(self, name: str, count: int) -> Array:
        first, self.size = self.size, self.size + count
        self.slices[name] = slice(first, self.size)
        return MARK + np.arange(first, self.size, dtype=np.float64)


@dataclass(frozen=True)
class StateModel:
    """A formulation's part of the program: miss and state constraints as functions of the burns.

    The miss has shape (6,), the y of n state constraints of dimension d (n, d), with buffers in this
    order; a block that is `shared` has one. `constraints` are the linearised dynamics, unless these are
    eliminated.
    """

    miss: cp.Expression
    rows: list[cp.Expression]
    constraints: list[cp.Constraint]
    shared: Sequence[bool]


StateModelWriter = Callable[[cp.Variable, Numbers], StateModel]
"""Writes the model of all controls; what changes between iterations is among the numbers."""


@dataclass(frozen=True)
class Model:
    """The program with its controls, its parameters by name, and its other numbers."""

    program: cp.Problem
    controls: cp.Variable
    parameters: Mapping[str, cp.Parameter]
    numbers: Numbers = field(default_factory=Numbers)


class Shape(NamedTuple):
    """The controls of a program.

    Attributes:
        first: number of controls of a number of burns, m + 1: see `FlybyProblem.controls_before`.
        corrected: numbers of the burns that are corrected.
        cost: what is minimised.
        floor: whether some burns are raised.
        times: the controls that are firing times and phases.
        rules: number of the rules on these.
    """

    first: tuple[int, ...]
    corrected: tuple[int, ...] = ()
    cost: Cost = "nominal"
    floor: bool = False
    times: tuple[int, ...] = ()
    rules: int = 0

    @classmethod
    def of(cls, problem: FlybyProblem, *, floor: bool) -> Self:
        """The controls of a problem."""
        feedback, firing = problem.feedback, problem.firing
        shape = cls(tuple(problem.controls_before.tolist()), floor=floor)
        if firing is not None:
            times = tuple(problem.time_controls.tolist())
            shape = shape._replace(times=times, rules=len(firing.least))
        if feedback is None:
            return shape
        return shape._replace(corrected=tuple(feedback.burns.tolist()), cost=feedback.cost)

    @property
    def burns(self) -> int:
        """Number m of the burns."""
        return len(self.first) - 1

    def split(self, controls: cp.Variable) -> tuple[cp.Expression, list[cp.Expression]]:
        """Burns (m, 3), and the gains of each corrected one."""
        if not self.corrected and not self.times:
            return cp.reshape(controls, (self.burns, 3), order="C"), []
        parts = [controls[start : start + 3] for start in self.first[:-1]]
        gains = [self.first[i] + 3 for i in self.corrected]
        own = [controls[start : start + 18 * (j + 1)] for j, start in enumerate(gains)]
        return cp.vstack(parts), own


def write_cost(
    shape: Shape, controls: cp.Variable, size: cp.Variable, numbers: Numbers
) -> tuple[cp.Expression, dict[str, cp.Parameter]]:
    """The objective: the sum of the burns' sizes, or with corrections its mean or its 99 % quantile.

    See `formulations.problem.cost`.
    """
    burns, gains = shape.split(controls)
    if not gains:
        return cp.sum(size), {}
    if shape.cost == "nominal":
        return cp.sum(size) + SMALLEST * sum(cp.norm(one) for one in gains), {}
    fixed = [i for i in range(shape.burns) if i not in shape.corrected]
    tilt = cp.Parameter(controls.size)
    total = cp.sum(size[fixed]) + tilt @ controls
    for j, (i, one) in enumerate(zip(shape.corrected, gains, strict=True)):
        if shape.cost == "expected":
            total += cp.norm(cp.hstack([burns[i], one]))
            continue
        known = one.size // 3
        both = cp.hstack([burns[[i]].T, cp.reshape(one, (3, known), order="C")])
        total += cp.norm(both @ numbers.array(f"root_{j}", 1 + known, 1 + known), "fro")
    if shape.cost == "expected":
        return total, {"tilt": tilt}
    for part, n in enumerate((gains[-1].size // 3, sum(3 + one.size for one in gains))):
        bent = numbers.array(f"bend_{part}", n, controls.size) @ controls
        bent += numbers.array(f"bend_constant_{part}", n)
        total += cp.norm(cp.hstack([bent, numbers.array(f"bend_over_{part}", 1)]))
    return total, {"tilt": tilt}


def cost_values(lin: Linearisation) -> tuple[Values, float]:
    """Parameters of the cost at an iterate, and the constant that the objective leaves out."""
    problem, iterate, feedback = lin.problem, lin.iterate, lin.problem.feedback
    if feedback is None or feedback.cost == "nominal":
        return {}, 0.0
    at, true, roots = lin.controls, lin.cost, roots_of(problem, iterate)
    own = formula(problem, iterate, roots)
    value, slope, values = own.value, own.gradient.copy(), {}
    if feedback.cost == "dv99":
        values = {f"root_{j}": root for j, root in enumerate(roots)}
        for part, bend in enumerate(lin.bends):
            values[f"bend_{part}"] = bend.root
            values[f"bend_constant_{part}"] = bend.start - bend.root @ at
            values[f"bend_over_{part}"] = np.array(bend.over)
            value, slope = value + bend.at.value, slope + bend.at.gradient
    values["tilt"] = true.gradient - slope
    left = true.value - value - float(values["tilt"] @ at)
    return values, left


def write_model(shape: Shape, penalty: Penalty, write_states: StateModelWriter) -> Model:
    """Write the program with one formulation's states and one penalty."""
    m = shape.burns
    z = cp.Variable(shape.first[-1])
    size, squares, numbers = cp.Variable(m), cp.Variable(), Numbers()
    states = write_states(z, numbers)
    blocks = list(zip(states.rows, states.shared, strict=True))
    n_rows = sum(1 if shared else rows.shape[0] for rows, shared in blocks)
    excess, violation = cp.Variable(6), cp.Variable(3 * m + n_rows)
    charged = cp.hstack([excess, violation])
    own = {
        "centre": cp.Parameter(z.size),
        "radius": cp.Parameter(z.size),
        "dv_max": cp.Parameter(),
        "cone_normals": cp.Parameter((2 * m, 3)),
        "prices": cp.Parameter(6 + 3 * m + n_rows),
    }
    step, (burns, _) = z - own["centre"], shape.split(z)
    total: cp.Expression | float = 0.0
    if penalty != "least":
        total, of_cost = write_cost(shape, z, size, numbers)
        own |= of_cost
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
    if shape.rules:
        own |= {"rules": cp.Parameter((shape.rules, len(shape.times)))}
        own |= {"rules_least": cp.Parameter(shape.rules)}
        constraints.append(own["rules"] @ z[list(shape.times)] >= own["rules_least"])
    if shape.floor:
        own |= {"floor_normals": cp.Parameter((m, 3)), "floor": cp.Parameter(m)}
        along = cp.sum(cp.multiply(own["floor_normals"], burns), axis=1)
        constraints.append(along >= own["floor"])
    first = 3 * m
    for y, shared in blocks:
        buffer = violation[first] if shared else violation[first : first + y.shape[0]]
        first += 1 if shared else y.shape[0]
        constraints.append(
            cp.SOC(y[:, 0] + buffer, y[:, 1:], axis=1) if y.shape[1] > 1 else y[:, 0] + buffer >= 0
        )
    if penalty == "augmented":
        constraints.append(states.miss == excess)
    else:
        constraints += [states.miss <= excess, -states.miss <= excess]
    objective = total + own["prices"] @ charged
    if penalty == "bounded":
        own |= {"budget": cp.Parameter(), "miss_price": cp.Parameter(nonneg=True)}
        objective = total + own["miss_price"] * cp.sum(excess)
        constraints.append(own["prices"] @ charged <= own["budget"])
    elif penalty == "proximal":
        own["curvature"] = cp.Parameter()
        objective += own["curvature"] * squares
        constraints.append(cp.sum_squares(step) <= squares)
    elif penalty == "augmented":
        own["root"] = cp.Parameter()
        objective += squares
        constraints.append(cp.sum_squares(own["root"] * charged) <= squares)
    return Model(cp.Problem(cp.Minimize(objective), constraints), z, own, numbers)


def penalty_values(
    penalty: Penalty,
    charge: PenaltyParameters,
    n_burns: int,
    rows: Indices,
    miss_weight: float | None = None,
) -> Values:
    """Values of prices and curvature or root for a charge; `rows` has each buffer's row, -1 for none.

    The miss weight is `FlybyProblem`'s; the penalty "augmented" does not support one.
    """
    limits = 6 + 3 * n_burns
    prices = np.full(limits + len(rows), charge.weight)
    if penalty == "augmented":
        assert charge.multipliers is not None
        prices[:limits] = charge.multipliers[:limits]
        prices[limits:] = np.where(rows < 0, 0.0, charge.multipliers[limits:][rows])
        return {"prices": prices, "root": np.array(np.sqrt(0.5 * charge.weight))}
    if penalty in ("least", "bounded"):
        prices[:] = 1.0
        prices[:6] = DYNAMICS_WEIGHT if miss_weight is None else 0.0
        budget = {"budget": np.array(charge.budget), "miss_price": np.array(miss_weight or 0.0)}
        return {"prices": prices} | (budget if penalty == "bounded" else {})
    prices[:6] = charge.weight * DYNAMICS_WEIGHT if miss_weight is None else miss_weight
    if penalty == "proximal":
        return {"prices": prices, "curvature": np.array(0.5 * charge.prox)}
    return {"prices": prices}


class CompiledProgram:
    """A model reduced to cones: values of parameters and numbers in, a `ConeProgram` out.

    CVXPY reduces the parametrised program to cones once (DPP). An iteration then only evaluates that
    form, a linear map from the values to q, A and b with fixed sparsity, so that a solver can be
    updated in place. Values are arguments of the call: a compiled program has no state and can be
    shared.

    Raises:
        ValueError: if it is not a disciplined parametrised convex program.
    """

    def __init__(self, model: Model) -> None:
        if not model.program.is_dcp(dpp=True):
            raise ValueError("the program is not disciplined convex in its parameters")
        for parameter in model.parameters.values():
            parameter.value = np.zeros(parameter.shape)
        # Clarabel's is the form of every solver of second-order cones: zero, non-negative, then these.
        options = {"use_quad_obj": False}
        data, _, _ = model.program.get_problem_data(
            cp.CLARABEL, canon_backend="COO", solver_opts=options
        )
        self._form: Any = data[cp.settings.PARAM_PROB]
        column, constants = self._form.param_id_to_col, self._form.total_param_size + 1
        self._first = {name: column[one.id] for name, one in model.parameters.items()}
        self._first |= {name: constants + s.start for name, s in model.numbers.slices.items()}
        self._size = constants + model.numbers.size
        first = self._form.var_id_to_col[model.controls.id]
        self._controls = slice(first, first + model.controls.size)
        # Maps of all parameters, 1 and the numbers to the cost, and to [A b] column by column.
        rows, columns = self._form.constr_size, self._form.x.size
        both, cost = sp.coo_array(self._form.A), sp.csr_array(self._form.q)
        # Only entries that can be other than zero are indexed: a large program has few of all.
        filled, place = np.unique(both.row, return_inverse=True)
        share, number = found(both, model.numbers)
        maps = sp.csr_array((share, (place, number)), shape=(len(filled), self._size))
        split = int(np.searchsorted(filled, rows * columns))
        entries, self._entries = filled[:split], maps[:split]
        own = filled[split:] - rows * columns, np.arange(len(filled) - split)
        bound = sp.csr_array((np.ones(len(own[1])), own), shape=(rows, len(own[1])))
        self._cost, self._bound = cost[:columns], bound @ maps[split:]
        starts = np.searchsorted(entries, rows * np.arange(columns + 1))
        # QOCO takes 32-bit indices only.
        self._row, self._starts = (entries % rows).astype(np.int32), starts.astype(np.int32)

    def evaluate(self, values: Mapping[str, Array]) -> ConeProgram:
        """The program for the values of every parameter and number, by name.

        As `ParamConeProg.apply_parameters`, without computing the sparsity again.
        """
        form = self._form
        given = np.ones(self._size)
        for name, value in values.items():
            first = self._first[name]
            given[first : first + value.size] = value.ravel(order="F")
        shape = form.constr_size, form.x.size
        matrix = sp.csc_array((-(self._entries @ given), self._row, self._starts), shape=shape)
        dims = form.cone_dims
        return ConeProgram(
            self._cost @ given[: self._cost.shape[1]],
            matrix,
            self._bound @ given,
            dims.zero,
            dims.nonneg,
            tuple(dims.soc),
            form,
        )

    def controls(self, x: Array) -> Array:
        """The controls in an answer."""
        return x[self._controls].copy()


def found(maps: sp.coo_array, numbers: Numbers) -> tuple[Array, Indices]:
    """Shares and columns of a tensor's entries, of numbers sign and column behind the others.

    Raises:
        ValueError: if a number does not stand alone in its entries.
    """
    share, column = maps.data.copy(), maps.col.astype(np.intp)
    if not numbers.size:
        return share, column
    marked = np.abs(share) >= MARK
    number = (np.abs(share[marked]) - MARK).astype(np.intp)
    known = number[number < numbers.size]
    if len(known) < len(number) or not np.bincount(known, minlength=numbers.size).all():
        raise ValueError("a number of the program does not stand alone in its entries")
    share[marked], column[marked] = np.sign(share[marked]), maps.shape[1] + number
    return share, column
