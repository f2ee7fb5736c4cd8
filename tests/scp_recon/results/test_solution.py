"""From a plan to a solution: SI, consistent, and honest about what is violated."""

from dataclasses import asdict

import numpy as np
import pytest


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
