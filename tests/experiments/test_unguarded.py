"""Successive convex programming without a trust region or a test."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.optimize import linprog

from experiments.compare_solvers.cell import Unguarded
from formulations.linearisation.linearisation import (
    Linearisation,
    condense,
    final_state_map,
)
from formulations.registry import make_subproblem
from formulations.rows.uniform import ChanceRows
from scp_recon.mission.mission import Mission
from scp_recon.planning import initial_guess
from scp_recon.planning.plan import Plan
from scp_recon.planning.planner import plan
from scp_recon.scp.loop import Record, State, Timing, run
from scp_recon.scp.status import Status


@pytest.fixture(scope="module")
def full(mission: Mission) -> Plan:
    return plan(mission, initial_guess.cold(mission))


@pytest.fixture(scope="module")
def rows(full: Plan) -> ChanceRows:
    found = full.stages[1].merit.rows
    assert isinstance(found, ChanceRows)
    return found


def feasible_points(mission: Mission, rows: ChanceRows, lin: Linearisation) -> int:
    """SciPy's word on burns in a box that meet every facet with the covariance of an iterate."""
    s, facets = condense(lin, rows.nodes, factor=False), rows.carried
    at = np.searchsorted(rows.nodes, facets.node)
    spread = np.linalg.norm(
        np.einsum("mi,mic->mc", facets.normal, lin.factor[facets.node, :3]), axis=1
    )
    left = np.einsum("mi,miz->mz", facets.normal, s.mean_jacobian[at, :3])
    right = facets.offset - facets.quantile * spread
    right -= np.einsum("mi,mi->m", facets.normal, s.mean_constant[at, :3])
    constant, jacobian = final_state_map(lin)
    limit = mission.problem.dv_max
    return linprog(
        np.zeros(left.shape[1]),
        A_ub=left,
        b_ub=right,
        A_eq=jacobian,
        b_eq=mission.problem.final_state - constant,
        bounds=(-limit, limit),
    ).status


def steps(mission: Mission, rows: ChanceRows, start: Linearisation) -> list[tuple[State, Record]]:
    """The states after each iteration with a frozen covariance, up to a verdict."""
    subproblem = make_subproblem(mission.problem, rows, "frozen-covariance")
    algorithm, found = Unguarded(mission.problem), []
    state = algorithm.init(subproblem, start)
    for k in range(1, algorithm.max_iterations + 1):
        state, record = algorithm.step(subproblem, mission.dynamics, state, k, Timing())
        found.append((state, record))
        if algorithm.terminate(subproblem, state, record):
            return found
    raise AssertionError("no verdict")


def test_the_full_linearisation_needs_no_guard_here(
    mission: Mission, full: Plan, rows: ChanceRows
) -> None:
    subproblem = make_subproblem(mission.problem, rows)
    start = full.stages[0].result.lin
    result = run(subproblem, mission.dynamics, start, Unguarded(mission.problem), lambda _: None)
    assert result.status is Status.CONVERGED
    expected = full.final.result.lin.iterate.total_dv
    assert result.lin.iterate.total_dv == pytest.approx(expected, rel=1e-5)


def test_a_frozen_covariance_has_no_feasible_point_where_the_problem_has_one(
    mission: Mission, full: Plan, rows: ChanceRows
) -> None:
    start = full.stages[0].result.lin
    found = steps(mission, rows, start)
    algorithm = Unguarded(mission.problem)
    subproblem = make_subproblem(mission.problem, rows, "frozen-covariance")
    assert algorithm.terminate(subproblem, *found[-1]) is Status.INFEASIBLE
    iterates = [start, *(state.lin for state, _ in found)]
    solved, infeasible = 0, 2  # words of linprog
    assert feasible_points(mission, rows, iterates[0]) == solved
    assert feasible_points(mission, rows, iterates[-2]) == infeasible
