"""The compiled program is CVXPY's own, evaluated; and it has no state."""

from collections.abc import Callable
from functools import partial
from typing import Any

import cvxpy as cp
import numpy as np
import pytest
import scipy.sparse as sp
from hypothesis import given, settings

from formulations.arrays import Array, Indices
from formulations.program import model as written
from formulations.program.condensed import ConeSize, write_states
from formulations.program.lifted import LiftedSubproblem
from formulations.program.model import CompiledProgram, Model, Numbers, Shape, write_model
from formulations.program.subproblem import Penalty
from tests.helpers import generators, share_of_examples

from .support import PENALTIES, every_row, linearised

SIZES = (
    ConeSize(1, 3, triangular=False, slots=3),
    ConeSize(4, 6, triangular=False, slots=2),
    ConeSize(8, 6, triangular=True, slots=3),
    ConeSize(3, 6, triangular=False, slots=2, shared=True),
)
CORRECTED = Shape((0, 3, 24, 63), (1, 2), "dv99"), ConeSize(3, 24, triangular=True, slots=2)


def lifted_model(penalty: Penalty, name: str) -> Model:
    lin = linearised(np.random.default_rng(1))
    subproblem = LiftedSubproblem(lin.problem, every_row(lin, name, 4), penalty, "CLARABEL")
    return write_model(
        Shape.of(lin.problem, floor=False), penalty, partial(subproblem._states, lin)
    )


def condensed_model(penalty: Penalty, shape: Shape, *sizes: ConeSize) -> Model:
    return write_model(shape, penalty, partial(write_states, sizes))


MODELS: dict[str, Callable[[Penalty], Model]] = {
    "condensed": lambda penalty: condensed_model(penalty, Shape((0, 3, 6, 9, 12)), *SIZES),
    "with corrected burns": lambda penalty: condensed_model(penalty, *CORRECTED),
    "lifted P3": lambda penalty: lifted_model(penalty, "P3"),
    "lifted P2": lambda penalty: lifted_model(penalty, "P2"),
}


class Parameters(Numbers):
    """Numbers as parameters of CVXPY, whose own form is then the whole program's."""

    def __init__(self) -> None:
        super().__init__()
        self.own: dict[str, cp.Parameter] = {}

    def array(self, name: str, *shape: int) -> cp.Parameter:
        super().array(name, *shape)
        self.own[name] = cp.Parameter(shape)
        return self.own[name]

    def matrix(
        self, name: str, shape: tuple[int, int], rows: Indices, columns: Indices
    ) -> cp.Expression:
        super().matrix(name, shape, rows, columns)
        self.own[name], n = cp.Parameter(len(rows)), len(rows)
        places = rows + shape[0] * columns, np.arange(n)
        spread = sp.csr_array((np.ones(n), places), shape=(shape[0] * shape[1], n))
        return cp.reshape(spread @ self.own[name], shape, order="F")


def parametric(kind: str, penalty: Penalty, monkeypatch) -> tuple[Any, dict[str, cp.Parameter]]:
    """CVXPY's own form of a model, and its parameters by name."""
    monkeypatch.setattr(written, "Numbers", Parameters)
    model = MODELS[kind](penalty)
    monkeypatch.undo()
    assert isinstance(model.numbers, Parameters)
    parameters = {**model.parameters, **model.numbers.own}
    for parameter in parameters.values():
        parameter.value = np.zeros(parameter.shape)
    options = {"use_quad_obj": False}
    data, _, _ = model.program.get_problem_data(cp.CLARABEL, solver_opts=options)
    return data[cp.settings.PARAM_PROB], parameters


def random_values(
    parameters: dict[str, cp.Parameter], rng: np.random.Generator
) -> dict[str, Array]:
    """Of every parameter, some of them exactly zero."""
    return {
        name: rng.normal(size=parameter.shape) * (rng.uniform(size=parameter.shape) < 0.8)
        for name, parameter in parameters.items()
    }


@pytest.mark.slow
@pytest.mark.parametrize("penalty", PENALTIES)
@pytest.mark.parametrize("kind", MODELS)
def test_its_numbers_are_what_cvxpys_own_form_gives(kind, penalty, monkeypatch):
    model, (form, parameters) = MODELS[kind](penalty), parametric(kind, penalty, monkeypatch)
    compiled = CompiledProgram(model)
    assert bool(model.numbers.size) == ("lifted" not in kind)
    sparsity: list[tuple[Array, Array]] = []

    @settings(max_examples=share_of_examples(50, usual=2))
    @given(generators)
    def check(rng: np.random.Generator) -> None:
        values, between = random_values(parameters, rng), random_values(parameters, rng)
        program = compiled.evaluate(values)
        kept = program.cost.copy(), program.matrix.data.copy(), program.bound.copy()
        by_id = {parameters[name].id: value for name, value in values.items()}
        assert set(by_id) == set(form.id_to_param)
        q, _, a, b = form.apply_parameters(by_id, keep_zeros=True)
        a.sort_indices()
        assert program.matrix.shape == a.shape
        assert np.array_equal(program.matrix.indptr, a.indptr)
        assert np.array_equal(program.matrix.indices, a.indices)
        # To the order in which a sum is taken.
        for ours, theirs in ((program.cost, q), (program.matrix.data, -a.data), (program.bound, b)):
            np.testing.assert_allclose(ours, theirs, rtol=1e-14, atol=1e-14)
        cones = form.cone_dims
        counts = program.zero, program.nonnegative, list(program.second_order)
        assert counts == (cones.zero, cones.nonneg, list(cones.soc))
        assert cones.zero + cones.nonneg + sum(cones.soc) == len(b)
        # It has no state: nothing that comes between is left in it.
        compiled.evaluate(between)
        for parameter in model.parameters.values():
            parameter.value = np.full(parameter.shape, 7.0)
        for again in (program, compiled.evaluate(values)):
            for ours, first in zip((again.cost, again.matrix.data, again.bound), kept, strict=True):
                assert np.array_equal(ours, first)
        sparsity.append((program.matrix.indices.copy(), program.matrix.indptr.copy()))
        assert all(np.array_equal(x, y) for x, y in zip(sparsity[0], sparsity[-1], strict=True))

    check()
    assert len(sparsity) >= 2


def test_a_number_in_a_sum_is_refused():
    z, numbers = cp.Variable(2), Numbers()
    sums = numbers.array("one", 2) + numbers.array("other", 2)
    program = cp.Problem(cp.Minimize(cp.sum(z)), [z >= sums])
    with pytest.raises(ValueError, match="stand alone"):
        CompiledProgram(Model(program, z, {}, numbers))


def test_a_program_that_is_not_disciplined_is_refused():
    burns, one, other = cp.Variable(3), cp.Parameter(3), cp.Parameter()
    parameters = {"one": one, "other": other}
    products = cp.Problem(cp.Minimize((other * one) @ burns), [cp.norm(burns) <= 1.0])
    assert products.is_dcp()
    concave = cp.Problem(cp.Minimize(-cp.norm(burns)), [burns <= one * 1.0, other * burns <= one])
    for program in (products, concave):
        with pytest.raises(ValueError, match="disciplined convex"):
            CompiledProgram(Model(program, burns, parameters))


def test_burns_are_values_of_their_own_variables():
    """Min sum of ||z_i|| with z on planes: each burn has an answer of its own."""
    before, burns, sizes = cp.Variable(5), cp.Variable(6), cp.Variable(2)
    target = cp.Parameter(6)
    constraints = [
        before == np.arange(5.0),
        cp.SOC(sizes, cp.reshape(burns, (2, 3), order="C"), axis=1),
        burns >= target,
    ]
    model = Model(cp.Problem(cp.Minimize(cp.sum(sizes)), constraints), burns, {"target": target})
    compiled, wanted = CompiledProgram(model), np.arange(1.0, 7.0)
    program = compiled.evaluate({"target": wanted})
    target.value = wanted
    model.program.solve(solver=cp.CLARABEL)
    x = np.zeros(program.form.x.size)
    for variable in (before, burns, sizes):
        first = program.form.var_id_to_col[variable.id]
        x[first : first + variable.size] = variable.value
    assert compiled.controls(x) == pytest.approx(wanted.ravel(), rel=1e-6)
