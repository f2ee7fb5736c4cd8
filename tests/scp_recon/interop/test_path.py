"""A plan's path: flown, split at burns, dense enough."""

from __future__ import annotations

import itertools
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from scp_recon.errors import InputError
from scp_recon.interop import path as path_module
from scp_recon.interop.export import Export
from scp_recon.interop.path import MARGIN_S, WITHIN_M, fly_path
from scp_recon.mission.mission import Mission
from scp_recon.results.solution import Solution
from tests.scp_recon.support import fly, integrate


def test_there_is_a_coast_on_each_side_of_each_burn_which_is_a_jump_of_the_velocity(
    export: Export,
) -> None:
    coasts, firing = export.path.coasts, export.mission.scenario.burns.times_s
    edges = [(c.times_s[0], c.times_s[-1]) for c in coasts]
    assert edges == list(itertools.pairwise((firing[0] - MARGIN_S, *firing, firing[-1] + MARGIN_S)))
    assert all((np.diff(coast.times_s) > 0.0).all() for coast in coasts)
    for burn, (before, after) in zip(
        export.solution.burns_m_s, itertools.pairwise(coasts), strict=True
    ):
        jump = after.states[0] - before.states[-1]
        np.testing.assert_allclose(jump[:3], 0.0, atol=1e-9)
        np.testing.assert_allclose(jump[3:], burn, atol=1e-12)
    np.testing.assert_allclose(coasts[0].states[-1], export.mission.initial_state, rtol=1e-14)
    off = coasts[-1].states[0] - export.mission.final_state
    assert np.linalg.norm(off[:3]) < 1e-3
    assert np.linalg.norm(off[3:]) < 1e-7


def test_states_are_those_of_another_integrator(export: Export) -> None:
    times = np.array(export.solution.nodes.t_s)
    expected = fly(export.mission, export.solution.burns_m_s, times)
    for coast in export.path.coasts[1:-1]:
        at = np.flatnonzero(np.isin(coast.times_s, times[:-1]))[:-1]
        node = np.searchsorted(times, coast.times_s[at])
        np.testing.assert_allclose(coast.states[at, :3], expected[node, :3], atol=1e-5)
        np.testing.assert_allclose(coast.states[at, 3:], expected[node, 3:], atol=1e-9)


def test_covariances_are_the_plans_at_its_nodes(export: Export) -> None:
    stored = np.array(export.solution.nodes.covariance)
    times, seen = np.array(export.solution.nodes.t_s), 0
    scale = np.outer(export.mission.units.state, export.mission.units.state)
    for coast in export.path.coasts[1:]:
        at = np.flatnonzero(np.isin(coast.times_s, times))
        at = at if coast is export.path.coasts[-1] else at[:-1]  # a burn adds its errors
        node, seen = np.searchsorted(times, coast.times_s[at]), seen + len(at)
        off = np.abs(coast.covariances[at] - stored[node]) / scale
        assert off.max() < 1e-6 * np.abs(stored / scale).max()
    assert seen == len(times)


@given(share=st.floats(0.0, 1.0 - 1e-9))
def test_straight_lines_between_neighbours_are_within_a_centimetre(
    export: Export, share: float
) -> None:
    for coast in export.path.coasts:
        span = coast.times_s[-1] - coast.times_s[0]
        time = coast.times_s[0] + share * span
        k = int(np.searchsorted(coast.times_s, time, side="right")) - 1
        a, b = coast.times_s[k : k + 2]
        exact = integrate(export.mission.forces, coast.states[k], [a, max(time, a + 1e-6)])[-1]
        weight = (time - a) / (b - a)
        line = (1.0 - weight) * coast.states[k, :3] + weight * coast.states[k + 1, :3]
        assert np.linalg.norm(line - exact[:3]) <= max(coast.linear_error_m, 1e-6) * 1.001
        assert coast.linear_error_m <= WITHIN_M


def test_a_path_that_bends_more_gets_more_states(
    mission: Mission, solution: Solution, export: Export, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(path_module, "WITHIN_M", 1e-4)
    denser = fly_path(mission, solution)
    assert denser.linear_error_m <= 1e-4 < export.path.linear_error_m
    assert denser.size > 3 * export.path.size


def test_what_needs_too_many_states_is_refused(
    mission: Mission, solution: Solution, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(path_module, "STATES_MAX", 100)
    with pytest.raises(InputError, match="more than 100 states"):
        fly_path(mission, solution)


def test_nodes_that_are_not_where_the_burns_lead_are_refused(
    mission: Mission, solution: Solution
) -> None:
    states = [list(state) for state in solution.nodes.state]
    states[40][1] += 0.02
    nodes = replace(solution.nodes, state=states)
    with pytest.raises(InputError, match="where its burns lead"):
        fly_path(mission, replace(solution, nodes=nodes))
