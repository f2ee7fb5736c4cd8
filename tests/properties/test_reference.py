"""IPOPT's programs with corrected burns are the convex program's problem, and have its optimum."""

from __future__ import annotations

from dataclasses import replace
from typing import get_args

import casadi as ca
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.optimize import brentq

from formulations.arrays import Array
from formulations.linearisation.linearisation import Linearisation, condense
from formulations.nlp.program import Arcs, Start
from formulations.nlp.shooting import SingleShooting
from formulations.problem.execution_errors import (
    ComponentwiseErrors,
    ExecutionErrors,
    GatesErrors,
)
from formulations.problem.feedback import Cost
from formulations.problem.flyby import Iterate
from formulations.rows.uniform import ChanceRows
from tests.formulations.program.support import every_row
from tests.helpers import Waves, constrain, generators, random_flyby, share_of_examples

MODELS = [ComponentwiseErrors(0.05), GatesErrors(0.004, 0.02, 0.003, 0.03, 0.04)]


def casadi_arcs(waves: Waves) -> Arcs:
    """The same arcs over symbols; an arc's duration is its number."""
    x, k = ca.SX.sym("x", 6), ca.SX.sym("k")
    parts = zip(waves.linear, waves.amplitude, waves.frequency, strict=True)
    ends = [ca.DM(a) @ x + ca.DM(w) @ ca.sin(ca.DM(v) @ x) for a, w, v in parts]
    end = sum(((k == i) * end for i, end in enumerate(ends)), ca.SX(6, 1))
    return Arcs(ca.Function("flow", [x, k], [end]), np.arange(len(ends), dtype=float))


@given(generators, st.sampled_from(MODELS), st.sampled_from(get_args(Cost)))
@settings(max_examples=share_of_examples(10, usual=2))
def test_rows_cost_and_gradient_are_those_of_the_convex_side(
    rng: np.random.Generator, errors: ExecutionErrors, price: Cost
) -> None:
    """Whatever the burns and gains: the two are one problem. Gradients are CasADi's own."""
    coast = int(rng.integers(0, 2))
    flyby = constrain(rng, random_flyby(rng, nodes=7, burns=3, coast=coast)).corrected(rng, price)
    problem = replace(flyby.problem, execution_errors=errors)
    burns = flyby.burns + 0.1 * rng.normal(size=flyby.burns.shape)
    mean = flyby.waves.rollout(problem, burns).mean
    gains = 0.1 * rng.normal(size=len(problem.gain_controls))
    lin = flyby.waves.linearise(problem, Iterate(burns, mean, gains))
    rows = every_row(lin, "P2", 4)
    assert isinstance(rows, ChanceRows)
    start = Start(lin.iterate, lin.factor)
    program = SingleShooting()(problem, casadi_arcs(flyby.waves), rows.facets, start, False)
    point = program.start.copy()
    own, sizes = len(lin.controls), program.bounded - (price == "dv99")
    charged = range(3) if price == "nominal" else [0]
    point[own : own + len(charged)] = np.linalg.norm(burns, axis=1)[charged]
    if price == "nominal":
        parts = [problem.gains_of(lin.iterate, j) for j in range(2)]
        point[own + 3 : own + sizes] = [np.linalg.norm(part) for part in parts]
    blocks = {block.name: block.value for block in program.blocks}
    x = program.unknowns
    if price == "dv99":
        off = ca.Function("off", [x], [blocks["quantile"]])
        tail = brentq(lambda t: float(off(np.r_[point[:-1], t])), 1.0, 5.0, xtol=1e-14)
        point[-1] = tail
    found = program.iterate(point)
    np.testing.assert_allclose(found.mean, lin.iterate.mean, atol=1e-12)
    np.testing.assert_array_equal(found.gains, gains)
    said = program.residuals(point)
    np.testing.assert_allclose(said["sizes"], 0.0, atol=1e-12)
    margins = rows.margins(lin)
    assert margins.keys() < said.keys()
    for name, (_, margin) in margins.items():
        np.testing.assert_allclose(said[name], margin, rtol=1e-7, atol=1e-7, err_msg=name)
    value = ca.Function("cost", [x], [program.cost])
    assert float(value(point)) == pytest.approx(lin.cost.value, rel=1e-9)
    # Where the further unknowns are determined by their equations, a row's slope is its own less what
    # these move; cost and weighed rows one after the other.
    prices = {name: rng.normal(size=len(margin)) for name, (_, margin) in margins.items()}
    weighed = sum(ca.dot(ca.DM(price), blocks[name]) for name, price in prices.items())
    defined = ca.vertcat(blocks["sizes"], *(blocks[n] for n in ("quantile",) if n in blocks))
    slopes = ca.Function(
        "slopes", [x], [ca.jacobian(e, x) for e in (program.cost, weighed, defined)]
    )
    of_cost, of_rows, of_defined = (np.array(slope) for slope in slopes(point))
    moved = -np.linalg.solve(of_defined[:, own:], of_defined[:, :own])
    for slope, expected in (
        (of_cost, lin.cost.gradient),
        (of_rows, slope_of(rows, lin, prices)),
    ):
        total = slope[0, :own] + slope[0, own:] @ moved
        np.testing.assert_allclose(total, expected, atol=1e-6 * np.abs(expected).max())


def slope_of(rows: ChanceRows, lin: Linearisation, prices: dict[str, Array]) -> Array:
    """Gradient by all controls of the weighed margins, by the convex program's cones."""
    weights, slope = np.concatenate([*prices.values()]), np.zeros(len(lin.controls))
    for cones in rows.cones(lin, condense(lin, rows.nodes)):
        p, y = cones.values.shape[2], cones.at(lin.controls)
        size = np.maximum(np.linalg.norm(y[:, 1:], axis=1), 1e-300)
        bent = np.einsum("nd,ndp->np", y[:, 1:] / size[:, None], cones.values[:, 1:])
        slope[:p] += weights[cones.rows] @ (cones.values[:, 0] - bent)
    return slope
