"""From a plan to a solution: SI, consistent, and honest about what is violated."""

import itertools
from dataclasses import asdict

import numpy as np
import pytest


def test_stored_nodes_are_after_the_burns(mission, solution):
    assert tuple(burn.t_s for burn in solution.burns) == solution.scenario.burns.times_s
    sizes = np.linalg.norm(solution.burns_m_s, axis=1)
    assert solution.total_dv_m_s == pytest.approx(sizes.sum(), rel=1e-12)
    assert np.all(sizes <= 0.2)
    first, last = np.array(solution.nodes.state[0]), np.array(solution.nodes.state[-1])
    jump = np.concatenate([np.zeros(3), solution.burns_m_s[0]])
    np.testing.assert_allclose(first, mission.initial_state + jump, rtol=0.0, atol=1e-9)
    np.testing.assert_allclose(last[:3], mission.final_state[:3], rtol=0.0, atol=1e-3)
    np.testing.assert_allclose(last[3:], mission.final_state[3:], rtol=0.0, atol=1e-6)


def test_covariances_are_valid_from_the_first_burn(mission, solution):
    covariance = np.array(solution.nodes.covariance)
    assert covariance.shape == (len(mission.times_s), 6, 6)
    np.testing.assert_allclose(covariance, covariance.transpose(0, 2, 1), rtol=1e-12)
    scaled = covariance / np.outer(mission.units.state, mission.units.state)
    assert np.linalg.eigvalsh(scaled).min() > 0.0
    expected = 1e-4 * np.diag(mission.initial_state**2)
    expected[3:, 3:] += 0.08**2 * np.diag(solution.burns_m_s[0] ** 2)
    np.testing.assert_allclose(covariance[0], expected, rtol=1e-9, atol=1e-18)


def test_stages_and_iterations_tell_one_story(solution):
    assert [stage.name for stage in solution.stages] == ["P3", "P2"]
    told = [(stage.name, k) for stage in solution.stages for k in range(1, stage.iterations + 1)]
    assert [(i.stage, i.k) for i in solution.iterations] == told
    assert solution.stages[-1].total_dv_m_s == pytest.approx(solution.total_dv_m_s)
    # At a feasible optimum the merit is the cost.
    assert solution.iterations[-1].merit == pytest.approx(solution.total_dv_m_s, rel=1e-6)
    for stage, group in itertools.groupby(solution.iterations, key=lambda i: i.stage):
        records = list(group)
        for before, after in itertools.pairwise(records):
            if after.accepted:
                drop = before.merit - after.merit
                assert drop == pytest.approx(after.actual, abs=1e-9), stage


def test_timing_adds_up(solution):
    parts = asdict(solution.timing_s)
    assert parts.pop("total") == pytest.approx(sum(parts.values()))
    assert min(parts.values()) >= 0.0
    solver = sum(i.solver_s for i in solution.iterations)
    assert parts["conic_solver"] == pytest.approx(solver)


def test_every_constraint_has_its_worst_margin(mission, solution):
    named = {c.name: c for c in solution.constraints}
    assert set(named) == {"dv_max", "dv_battery", *(c.name for c in mission.problem.constraints)}
    assert all(c.worst_margin >= -2e-3 for c in named.values())  # a millimetre
    in_window = [c for name, c in named.items() if not name.startswith(("dv_", "safety"))]
    first, last = mission.schedule.window_s
    assert all(first <= c.worst_t_s <= last for c in in_window)
    facets = {"site_distance_max": 24, "emission_max": 4, "site_distance_min": 1}
    assert {name: named[name].facets for name in facets} == facets
    sizes = np.linalg.norm(solution.burns_m_s, axis=1)
    assert named["dv_max"].unit == "m/s"
    assert named["dv_max"].worst_margin == pytest.approx(0.2 - sizes.max())
    assert named["dv_max"].worst_t_s == solution.burns[int(np.argmax(sizes))].t_s
    kinds = {name: c.kind for name, c in named.items()}
    assert kinds["emission_max"] == "keep_in"
    assert kinds["safety_radius"] == kinds["phase_min"] == "keep_out"
    assert kinds["dv_max"] == "burn"


def test_the_primer_is_known_at_every_node(solution):
    primer = solution.primer
    assert primer.t_s == solution.nodes.t_s
    assert np.all(np.array(primer.allowed) <= np.linalg.norm(primer.vector, axis=1) + 1e-12)
    assert primer.residual < 1e-3
    assert not any(primer.legal)  # four burns leave none of the default flight's gaps to a fifth
