"""Accepted and refused steps, by a stub's predicted and actual reductions alone."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from formulations.program.subproblem import PenaltyParameters, Step
from scp_recon.scp import algorithms
from scp_recon.scp.algorithms import ALGORITHMS
from scp_recon.scp.loop import Record, State, Timing, Trial
from scp_recon.scp.status import Status

STEP = 0.1


def at(burns: float, *, flown: bool = True) -> Any:
    """A linearisation of which only the burns are known."""
    iterate = SimpleNamespace(burns=np.full((2, 3), burns), total_dv=1.0)
    controls = iterate.burns.ravel()
    problem = SimpleNamespace(controls=lambda burns, _: burns.ravel())
    return SimpleNamespace(
        is_dynamically_feasible=flown, iterate=iterate, controls=controls, problem=problem
    )


class Merit:
    """Of a problem without constraints, at an iterate with nothing violated."""

    def violations(self, _: object) -> dict[str, Any]:
        return {"dynamics": np.zeros((1, 6)), "rows": np.zeros(1)}

    def cost(self, _: object) -> float:
        return 1.0

    def excess(self, _: object) -> Any:
        return np.zeros(7)

    def __call__(self, *_: object) -> float:
        return 1.0


STUB = SimpleNamespace(merit=Merit())


@pytest.fixture(params=["scvx", "ptr", "scvx-star"])
def algorithm(request: pytest.FixtureRequest) -> Any:
    return ALGORITHMS[request.param]()


def after_a_step(
    monkeypatch: pytest.MonkeyPatch, algorithm: Any, predicted: float, actual: float, before: Any
) -> tuple[State, State]:
    """The state before and after a step with these reductions."""
    answer = Step(np.full((2, 3), STEP), 1.0 - predicted, 0.0, 0.0)
    trial = Trial(answer, at(STEP), 1.0 - actual, predicted, actual, STEP)
    monkeypatch.setattr(algorithms, "trial_step", lambda *_: trial)
    state = State(before, 1.0, 1.0, PenaltyParameters(10.0, multipliers=np.zeros(7)))
    new, record = algorithm.step(STUB, None, state, 2, Timing())
    assert record.accepted == (new.lin is trial.lin)
    return state, new


@pytest.mark.parametrize("actual", [-1e3, -1e-12, 0.0, 0.2, 3.0])
def test_a_step_is_taken_if_it_keeps_a_share_of_its_promise(
    monkeypatch: pytest.MonkeyPatch, algorithm: Any, actual: float
) -> None:
    before, after = after_a_step(monkeypatch, algorithm, 1.0, actual, at(0.0))
    assert (after.lin is before.lin) == (actual <= 0.0)
    assert after.merit == pytest.approx(1.0 - max(actual, 0.0))
    assert actual > 0.0 or after.radius < before.radius


def test_the_step_from_a_guess_is_taken_whatever_it_leads_to(
    monkeypatch: pytest.MonkeyPatch, algorithm: Any
) -> None:
    before, after = after_a_step(monkeypatch, algorithm, 1.0, -1e3, at(0.0, flown=False))
    assert after.lin is not before.lin


@pytest.mark.parametrize(("dv_max", "verdict"), [(0.1, Status.INFEASIBLE), (10.0, None)])
def test_the_dearest_plan_is_told_by_the_limits_of_the_merit(
    dv_max: float, verdict: Status | None
) -> None:
    """Above two burns of that size no plan can be; the iterate's own problem has other limits."""
    algorithm = algorithms.SCvx()
    subproblem: Any = SimpleNamespace(
        merit=SimpleNamespace(problem=SimpleNamespace(n_burns=2, dv_max=dv_max))
    )
    lin: Any = SimpleNamespace(problem=SimpleNamespace(n_burns=2, dv_max=1.0))
    charge = PenaltyParameters(algorithm.weight_max)
    state = State(lin, 1.0, 1.0, charge, stationary=True)
    record = Record(1, 1.0, 0.0, 0.0, True, 1.0, 0.2, 0.1, 0.0, 0.0, 0.0)
    assert algorithm.terminate(subproblem, state, record) is verdict
