"""Flows from expressions, against SciPy's integrators, known motions and differences of the map."""

from typing import Any

import casadi as ca
import numpy as np
import pytest
from scipy.integrate import solve_ivp

from formulations.arrays import Array
from formulations.problem.expression_flow import NUMPY, Columns, ExpressionFlow

MU = 1.215058560962404e-02
STARTS = np.array(
    [[1.081, 0.0, -0.202, 0.0, -0.199, 0.0], [1.165, 0.01, -0.111, 0.02, -0.202, 0.05]]
)


def cr3bp(r: Any, v: Any, t: Any, p: Any) -> list[Any]:
    """The restricted three-body problem in the rotating frame, its mass ratio a parameter."""
    del t
    near = (1.0 - p[0]) / ca.norm_2(r + ca.vertcat(p[0], 0, 0)) ** 3
    far = p[0] / ca.norm_2(r + ca.vertcat(p[0] - 1.0, 0, 0)) ** 3
    return [
        r[0] + 2.0 * v[1] - near * (r[0] + p[0]) - far * (r[0] + p[0] - 1.0),
        r[1] - 2.0 * v[0] - (near + far) * r[1],
        -(near + far) * r[2],
    ]


def driven(r: Any, v: Any, t: Any, p: Any) -> Any:
    """Damped oscillators, pushed in time, with a force of second order in the velocity."""
    return -p[0] * r - p[1] * v + ca.vertcat(ca.cos(2.0 * t), t * t * r[0], v[1] * r[2])


@pytest.fixture(scope="module")
def libration() -> ExpressionFlow:
    return ExpressionFlow(cr3bp, [0.0, 0.4, 1.0], parameters=[MU], substeps=120)


@pytest.mark.slow
@pytest.mark.parametrize("arc", [0, 1])
def test_the_flow_is_what_an_adaptive_integration_gives(libration, arc):
    def rate(t: float, y: Array) -> Array:
        return np.r_[y[3:], [float(x) for x in cr3bp(ca.DM(y[:3]), ca.DM(y[3:]), t, [MU])]]

    for start in STARTS:
        span = libration.times[arc : arc + 2]
        truth = solve_ivp(rate, span, start, rtol=1e-12, atol=1e-12).y[:, -1]
        assert libration.propagate(start, arc) == pytest.approx(truth, abs=1e-9)


def test_driven_oscillator_follows_its_closed_form():
    """x'' = -x + cos 2t has x = (4 cos t - cos 2t) / 3 from x = 1 at rest."""
    flow = ExpressionFlow(lambda r, _v, t, _p: -r + ca.cos(2.0 * t), np.linspace(0.0, 3.0, 61))
    end = np.ones((2, 6)) * [1.0, 1.0, 1.0, 0.0, 0.0, 0.0]
    for arc in range(60):
        end = flow.propagate(end, arc)
    x = (4.0 * np.cos(3.0) - np.cos(6.0)) / 3.0
    v = (2.0 * np.sin(6.0) - 4.0 * np.sin(3.0)) / 3.0
    assert end == pytest.approx(np.broadcast_to(np.repeat([x, v], 3), (2, 6)), abs=2e-6)


@pytest.mark.parametrize(("acceleration", "p"), [(cr3bp, [MU]), (driven, [1.3, 0.2])])
def test_derivatives_are_those_of_the_map(acceleration, p):
    times, h = [0.3, 0.5, 0.9], 1e-5

    def flow(parameters: Any) -> ExpressionFlow:
        return ExpressionFlow(acceleration, times, parameters=parameters, substeps=3)

    here, at = flow(p), flow(p).differentiate(STARTS)
    alone = [here.propagate(STARTS[k], k) for k in (0, 1)]
    assert at.state == pytest.approx(np.array(alone), abs=1e-14)
    for j, step in enumerate(h * np.eye(6)):
        ahead, behind = (here.differentiate(STARTS + side * step) for side in (1, -1))
        assert (ahead.state - behind.state) / (2 * h) == pytest.approx(at.stm[:, :, j], abs=1e-7)
        bent = (ahead.stm - behind.stm) / (2 * h)
        assert bent == pytest.approx(at.tensor[..., j], rel=1e-6, abs=1e-6)
        mixed = (ahead.by_parameters - behind.by_parameters) / (2 * h)
        assert mixed == pytest.approx(at.mixed[..., j], rel=1e-6, abs=1e-6)
    for j, step in enumerate(h * np.eye(len(p))):
        ahead, behind = (flow(p + side * step).differentiate(STARTS) for side in (1, -1))
        moved = (ahead.state - behind.state) / (2 * h)
        assert moved == pytest.approx(at.by_parameters[:, :, j], abs=1e-7)
    small = 1e-8 * np.ones((2, 6))
    moved_ = at.moved(small).state
    assert moved_ == pytest.approx(here.differentiate(STARTS + small).state, abs=1e-13)


def test_all_operations_are_casadis():
    x, y = ca.SX.sym("x"), ca.SX.sym("y")
    both = [x + y, x - y, x * y, x / y, x**y, x**3.7]
    both += [ca.atan2(x, y), ca.fmod(x, y), ca.copysign(x, -y)]
    both += [ca.fmin(x, y), ca.fmax(x, y), ca.hypot(x, y), ca.if_else(x < y, x, -y), 2.0 * x, 1 / y]
    both += [ca.logic_and(x < y, x <= 0.7), ca.logic_or(x == y, x != 0.5), ca.logic_not(x < y)]
    names = "exp sin cos tan asin acos atan sinh cosh tanh asinh atanh floor ceil sign fabs erf"
    names += " expm1 log1p"
    both += [getattr(ca, name)(x - 0.3) for name in names.split()]
    both += [ca.acosh(1.0 + x), ca.log(x), ca.sqrt(x), x * x, ca.SX(2.5)]
    function = ca.Function("f", [x, y], [ca.vertcat(*both)])
    at = np.array([[0.4, 0.9, 0.5], [0.8, 0.6, 0.5]])
    ours = Columns(function)([at[0]], [at[1]])[0]
    truth = np.hstack([np.array(function(*column)) for column in at.T])
    assert ours == pytest.approx(truth, rel=1e-13, abs=1e-15)
    used = {function.instruction_id(k) for k in range(function.n_instructions())}
    missing = {name for name in NUMPY if getattr(ca, f"OP_{name}") not in used}
    assert missing <= {"ASSIGN"}


@pytest.mark.parametrize(
    ("acceleration", "times", "says"),
    [
        (lambda r, *_: r[:2], [0.0, 1.0], r"expected an acceleration of shape \(3, 1\)"),
        (lambda r, v, *_: [r, v], [0.0, 1.0], r"expected an acceleration of shape \(3, 1\)"),
        (lambda r, *_: r, [0.0], "expected two ascending times or more"),
        (lambda r, *_: ca.remainder(r, 2.0), [0.0, 1.0], "without NumPy's"),
    ],
)
def test_what_is_no_flow_is_refused(acceleration, times, says):
    with pytest.raises(ValueError, match=says):
        ExpressionFlow(acceleration, times)
