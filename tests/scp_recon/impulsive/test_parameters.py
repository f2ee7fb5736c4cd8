"""Problems by hand whose flow has uncertain parameters."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

import scp_recon as sr
from scp_recon.errors import InputError

RATE, NODES, BURNS = 2.0 * np.pi / 5556.0, 25, [0, 8, 16, 24]
SPREAD = 0.06


def hill(r: Any, v: Any, t: Any, p: Any) -> list[Any]:
    """With a push along the track that nobody knows well."""
    del t
    w = p[0]
    return [3.0 * w**2 * r[0] + 2.0 * w * v[1], -2.0 * w * v[0] + p[1], -(w**2) * r[2]]


@pytest.fixture(scope="module")
def problem() -> sr.ImpulsiveProblem:
    """Out of a ball until the third burn."""
    times = np.linspace(0.0, 4000.0, NODES)
    flow = sr.ExpressionFlow(hill, times, parameters=[RATE, 0.0], substeps=3)
    start, goal = [-200.0, -900.0, 100.0, 0.0, 0.3, 0.0], [0.0, 250.0, 0.0, 0.0, 0.0, 0.0]
    return sr.ImpulsiveProblem(
        flow,
        BURNS,
        start,
        goal,
        dv_max=1.0,
        initial_covariance=np.diag([2.0, 2.0, 2.0, 0.001, 0.001, 0.001]) ** 2,
        regions=[sr.Keep("out", sr.Ball(np.zeros(3), 250.0), range(1, 17), "ball")],
        probability=0.95,
    )


COVARIANCE = np.diag([0.03 * RATE, 2e-5]) ** 2
"""Of the rate, 3 %, and of the push, which alone moves a flight by 160 m."""


@pytest.mark.slow
def test_plans_keep_their_probability_with_uncertain_parameters(problem):
    """The plan that knows them does not, and costs less."""
    uncertain = replace(problem, parameter_covariance=COVARIANCE)
    known, plan = problem.solve(), uncertain.solve()
    assert plan.ok
    assert plan.cost > 1.02 * known.cost
    flown = plan.fly(4000, seed=3)
    assert flown.kept["ball"].high > 0.95
    lin = plan.final.result.lin
    law = np.linalg.norm(lin.factor[-1], axis=1) * plan.unit
    ratio = (flown.final.std(axis=0) / law)[:3]
    assert ratio == pytest.approx(np.ones(3), abs=SPREAD)
    assert np.all(law[:2] > 50.0)


@pytest.mark.slow
def test_filters_learn_parameters_of_any_flow(problem):
    """Measurements before burns 2 and 3 leave less of the push unknown, and the end nearer."""
    uncertain = replace(problem, parameter_covariance=COVARIANCE)
    measurement = np.tile(np.diag([1.0, 1.0, 1.0, 0.001, 0.001, 0.001]), (2, 1, 1))
    feedback = sr.Feedback(np.array([1, 2]), np.array([7, 15]), measurement, "expected", 0.99)
    plan = replace(uncertain, feedback=feedback).solve()
    assert plan.ok
    lin = plan.final.result.lin
    before = np.linalg.norm(lin.spread.leg_errors[0][6:], axis=1)
    after = np.linalg.norm(lin.spread.leg_errors[-1][6:], axis=1)
    assert after[1] < 0.2 * before[1]
    flown = plan.fly(4000, seed=3)
    assert flown.kept["ball"].high > 0.95
    law = np.linalg.norm(lin.factor[-1], axis=1) * plan.unit
    ratio = (flown.final.std(axis=0) / law)[:3]
    assert ratio == pytest.approx(np.ones(3), abs=SPREAD)


def test_bad_covariances_of_parameters_are_named(problem):
    for covariance, words in (
        (np.diag([1.0, -1.0]), "no covariance"),
        (np.eye(3), "parameter_covariance"),
    ):
        with pytest.raises(InputError, match=words):
            replace(problem, parameter_covariance=covariance)
    with pytest.raises(InputError, match="goes with an ExpressionFlow"):
        replace(problem, flow=_Other(), parameter_covariance=COVARIANCE)


class _Other:
    """A flow without parameters."""

    arcs = NODES - 1
