"""Verification: it confirms a right solution, and every wrong one is found out."""

from __future__ import annotations

import io
import json
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from rich.console import Console

from formulations.arrays import Array
from scp_recon.cli.command import WIDE
from scp_recon.cli.plan_view import show_verification
from scp_recon.mission.mission import Mission
from scp_recon.monte_carlo.sampling import sample_positions
from scp_recon.physics.forces import acceleration, gravity_gradient
from scp_recon.planning import initial_guess
from scp_recon.planning.planner import plan
from scp_recon.results.facts import Verification
from scp_recon.results.read import parse_solution
from scp_recon.results.solution import Solution, make_solution
from scp_recon.verification.consistency import inconsistencies
from scp_recon.verification.probabilities import MARGIN_LIMIT, holds
from scp_recon.verification.reintegration import FIGURES, limits_of, variational_rate, verify
from tests.scp_recon.support import mission_of

Change = Callable[[dict[str, Any]], None]

# --- a right solution ---------------------------------------------------------------------------


def test_default_solution_is_confirmed(verification: Verification) -> None:
    v = verification
    assert v.ok
    assert v.failed == []
    assert v.terminal_position_error_m < 1.0
    assert v.terminal_velocity_error_m_s < 1e-4
    assert v.covariance_error < 1e-6
    assert v.max_defect < 1e-2


def test_what_is_shown_as_allowed_is_what_is_judged(
    solution: Solution, verification: Verification
) -> None:
    """About a body so large that the integrators differ by more than a centimetre."""
    mission = mission_of()
    limits = limits_of(mission)
    assert limits["sample_error_m"] == 0.01
    large = replace(mission, units=replace(mission.units, length_m=50_000.0))
    assert limits_of(large) == {**limits, "sample_error_m": pytest.approx(0.05)}
    assert limits.keys() == FIGURES.keys()
    shown = io.StringIO()
    show_verification(Console(file=shown, width=WIDE), large, solution, verification)
    row = next(line for line in shown.getvalue().splitlines() if line.startswith("sampled flights"))
    assert row.split()[-2:] == ["5.0e-02", "m"]


def test_every_joint_probability_reaches_what_was_asked(verification: Verification) -> None:
    names = {p.name for p in verification.probabilities}
    assert names == {"safety_radius", "site_distance", "emission", "phase", "battery_observation"}
    for p in verification.probabilities:
        assert p.low <= p.estimate <= p.high
        assert p.estimate >= 0.70


def test_every_original_constraint_is_looked_at(verification: Verification) -> None:
    margins = {m.name: m for m in verification.mean_margins}
    assert set(margins) >= {
        *("safety_radius", "site_distance_min", "site_distance_max", "emission_min"),
        *("emission_max", "phase_min", "battery_observation", "dv_max", "dv_battery"),
    }
    assert all(m.worst_margin > 0.0 for m in margins.values())
    assert 0.0 <= margins["safety_radius"].worst_t_s <= 34_842.0
    assert 13_139.0 <= margins["emission_max"].worst_t_s <= 16_539.0


def test_probability_is_that_of_counting(
    mission: Mission, solution: Solution, verification: Verification
) -> None:
    """The lowest probability of the site distance, counted again with different draws."""
    (site,) = (p for p in verification.probabilities if p.name == "site_distance")
    time = np.array([site.worst_t_s])
    positions = sample_positions(mission, solution.burns_m_s, time, 10_000, seed=77)[0]
    at = mission.rotation.body_to_j2000(site.worst_t_s) @ mission.site.position_body
    distance = np.linalg.norm(positions - at, axis=1)
    again = np.mean((distance >= 500.0) & (distance <= 740.0))
    sigma = np.sqrt(2.0 * site.estimate * (1.0 - site.estimate) / 10_000)
    assert again == pytest.approx(site.estimate, abs=4.5 * sigma)


def test_no_margin_at_the_solutions_own_nodes_is_below_the_worst(
    mission: Mission, solution: Solution, verification: Verification
) -> None:
    """The worst margin between the nodes cannot be better than that at the nodes."""
    states, times = np.array(solution.nodes.state), np.array(solution.nodes.t_s)
    worst = {m.name: m.worst_margin for m in verification.mean_margins}
    assert worst["safety_radius"] <= np.linalg.norm(states[:, :3], axis=1).min() - 500.0 + 1e-3
    window = mission.window_nodes
    to_j2000 = mission.rotation.body_to_j2000(times[window])
    offset = states[window, :3] - to_j2000 @ mission.site.position_body
    normal = to_j2000 @ mission.site.normal_body
    emission = np.arccos(np.sum(offset * normal, 1) / np.linalg.norm(offset, axis=1))
    assert worst["emission_min"] <= emission.min() - np.deg2rad(20.0) + 1e-6
    assert worst["emission_max"] <= np.deg2rad(45.0) - emission.max() + 1e-6


def test_p3_is_confirmed_without_asking_for_probabilities(mission: Mission) -> None:
    p3 = make_solution(plan(mission, initial_guess.cold(mission), problem="P3"))
    checked = verify(mission, p3)
    assert checked.ok
    assert min(p.estimate for p in checked.probabilities) < 0.70  # what P2 is for
    # An independent prototype: the lowest joint probability per node is one half.
    assert min(p.estimate for p in checked.probabilities) == pytest.approx(0.50, abs=0.05)


def test_the_same_solution_called_p2_is_not_confirmed(mission: Mission) -> None:
    p3 = make_solution(plan(mission, initial_guess.cold(mission), problem="P3"))
    checked = verify(mission, replace(p3, problem="P2"))
    assert not checked.ok
    assert all(name.startswith("P(") or name == "facets" for name in checked.failed)


# --- wrong solutions ----------------------------------------------------------------------------


def changed(solution: Solution, change: Change) -> Solution:
    data = json.loads(solution.text())
    change(data)
    return parse_solution(data, "changed")


def burn_component(data: dict[str, Any]) -> None:
    data["burns"][1]["dv_m_s"] = [x + 1e-3 for x in data["burns"][1]["dv_m_s"]]


def burn_time(data: dict[str, Any]) -> None:
    data["burns"][1]["t_s"] += 300.0


def total_dv(data: dict[str, Any]) -> None:
    data["total_dv_m_s"] *= 0.5


def node_position(data: dict[str, Any]) -> None:
    data["nodes"]["state"][70][1] += 1.0


def node_velocity(data: dict[str, Any]) -> None:
    data["nodes"]["state"][70][4] += 1e-3


def initial_node(data: dict[str, Any]) -> None:
    data["nodes"]["state"][0][0] += 1.0


def final_node(data: dict[str, Any]) -> None:
    data["nodes"]["state"][-1][0] += 1.0


def node_time(data: dict[str, Any]) -> None:
    data["nodes"]["t_s"][70] += 20.0


def covariance_entry(data: dict[str, Any]) -> None:
    data["nodes"]["covariance"][70][0][0] *= 1.001


def velocity_covariance(data: dict[str, Any]) -> None:
    data["nodes"]["covariance"][70][5][5] *= 2.0


def correlation(data: dict[str, Any]) -> None:
    for i, j in ((0, 1), (1, 0)):
        data["nodes"]["covariance"][70][i][j] *= -1.0


def first_covariance(data: dict[str, Any]) -> None:
    data["nodes"]["covariance"][0][0][0] *= 1.01


@pytest.mark.usefixtures("few_flights")
@pytest.mark.parametrize(
    "change",
    [
        *(burn_component, burn_time, total_dv, node_position, node_velocity, initial_node),
        *(final_node, node_time, covariance_entry, velocity_covariance, correlation),
        first_covariance,
    ],
)
def test_a_falsified_solution_is_found_out(
    mission: Mission, solution: Solution, change: Change
) -> None:
    checked = verify(mission, changed(solution, change))
    assert not checked.ok
    assert checked.failed


def constraint_margin(data: dict[str, Any]) -> None:
    data["constraints"][3]["worst_margin"] += 0.01


def burn_margin(data: dict[str, Any]) -> None:
    entry = next(c for c in data["constraints"] if c["name"] == "dv_max")
    entry["worst_margin"] += 1e-6


def worst_time(data: dict[str, Any]) -> None:
    data["constraints"][3]["worst_t_s"] = -99.0


def another_nodes_time(data: dict[str, Any]) -> None:
    entry = next(c for c in data["constraints"] if c["name"] == "dv_max")
    entry["worst_t_s"] = 25_000.0 if entry["worst_t_s"] != 25_000.0 else 0.0


def count_of_facets(data: dict[str, Any]) -> None:
    data["constraints"][2]["facets"] += 1


def kind_of_constraint(data: dict[str, Any]) -> None:
    entry = data["constraints"][2]
    entry["kind"] = "keep_in" if entry["kind"] != "keep_in" else "keep_out"


def unit_of_a_margin(data: dict[str, Any]) -> None:
    data["constraints"][2]["unit"] = "m/s"


def constraint_told_twice(data: dict[str, Any]) -> None:
    data["constraints"].append(data["constraints"][2])


def violation_in_a_rounding(data: dict[str, Any]) -> None:
    """Too small to contradict the margins: but where something is violated nothing has converged."""
    amount = {"max": 1e-3, "total": 1e-1, "unit": "m"}
    data["violation"] = {"max": 1e-3, "total": 1e-1, "by_constraint": {"safety_radius": amount}}


def constraint_left_out(data: dict[str, Any]) -> None:
    del data["constraints"][2]


def constraint_made_up(data: dict[str, Any]) -> None:
    data["constraints"].append({**data["constraints"][2], "name": "moonlight"})


def violation_made_up(data: dict[str, Any]) -> None:
    data["violation"]["by_constraint"]["emission_max"] = {"max": 1.0, "total": 1.0, "unit": "m"}


def violation_of_nothing(data: dict[str, Any]) -> None:
    data["violation"]["max"] = 1.0


def violation_in_sum(data: dict[str, Any]) -> None:
    data["violation"]["total"] = 1.0


def violation_of_next_to_nothing(data: dict[str, Any]) -> None:
    data["violation"]["total"] = 5e-324


def empty_violation(data: dict[str, Any]) -> None:
    data["violation"]["by_constraint"]["emission_max"] = {"max": 0.0, "total": 0.0, "unit": "m"}


def no_facets(data: dict[str, Any]) -> None:
    data["facets"] = None


def fewer_facets(data: dict[str, Any]) -> None:
    for column in data["facets"].values():
        del column[0]


def facets_of_nothing(data: dict[str, Any]) -> None:
    for column in data["facets"].values():
        column.clear()


def keep_out_plane_moved(data: dict[str, Any]) -> None:
    row = data["facets"]["constraint"].index("site_distance_min")
    data["facets"]["offset_m"][row] += 0.01


def keep_out_plane_turned(data: dict[str, Any]) -> None:
    row = data["facets"]["constraint"].index("emission_min")
    data["facets"]["normal"][row] = [-x for x in data["facets"]["normal"][row]]


def more_risk(data: dict[str, Any]) -> None:
    data["facets"]["quantile"][5] -= 0.01


def scaled_normal(data: dict[str, Any]) -> None:
    data["facets"]["normal"][5] = [0.5 * x for x in data["facets"]["normal"][5]]


def facet_of_another(data: dict[str, Any]) -> None:
    for column in data["facets"].values():
        column.append(column[-1])
    data["facets"]["constraint"][-1] = "moonlight"


@pytest.mark.parametrize(
    ("change", "named"),
    [
        *((c, "constraints") for c in (constraint_margin, burn_margin)),
        *((c, "constraints") for c in (constraint_left_out, constraint_made_up)),
        *((c, "constraints") for c in (worst_time, another_nodes_time, count_of_facets)),
        *(
            (c, "constraints")
            for c in (kind_of_constraint, unit_of_a_margin, constraint_told_twice)
        ),
        *((c, "violation") for c in (violation_made_up, violation_of_nothing)),
        (violation_in_a_rounding, "violation"),
        *((c, "violation") for c in (violation_in_sum, violation_of_next_to_nothing)),
        (empty_violation, "violation"),
        *((c, "facets") for c in (no_facets, fewer_facets, facets_of_nothing, more_risk)),
        *((c, "facets") for c in (keep_out_plane_moved, keep_out_plane_turned)),
        *((c, "facets") for c in (scaled_normal, facet_of_another)),
    ],
)
def test_what_is_said_of_the_constraints_is_worked_out_again(
    mission: Mission, solution: Solution, change: Change, named: str
) -> None:
    assert inconsistencies(mission, solution) == []
    assert inconsistencies(mission, changed(solution, change)) == [named]


@given(st.sampled_from(["m", "rad"]), st.floats(0.0, 0.9), st.floats(2.0, 100.0))
def test_flights_are_judged_as_the_mean_is_only_where_they_hardly_spread(
    unit: str, dip: float, spread: float
) -> None:
    """Without uncertainty every flight is the mean, whose constraints bind to the last digit."""
    limit = -MARGIN_LIMIT[unit]
    together = np.full((1, 100), -dip * limit)
    apart = np.linspace(-spread, spread, 100)[None] * limit
    assert holds(together, unit).all()
    assert not holds(together - 1.01 * limit, unit).any()
    assert holds(apart, unit).tolist() == (apart >= 0.0).tolist()


def test_the_constraints_of_p3_and_of_infeasible_cases_are_worked_out_again() -> None:
    for overrides, problem in (([], "P3"), (["burns.dv_max_m_s=0.03"], "P2")):
        case = mission_of(*overrides)
        found = plan(case, initial_guess.cold(case), problem=problem)
        assert inconsistencies(case, make_solution(found)) == []


@pytest.fixture(scope="module")
def infeasible() -> tuple[Mission, Solution]:
    """Burns too small for the flight: buffers of metres and of metres a second hold something."""
    case = mission_of("burns.dv_max_m_s=0.03")
    return case, make_solution(plan(case, initial_guess.cold(case)))


@pytest.mark.parametrize("figure", ["max", "total"])
@pytest.mark.parametrize("factor", [0.0, 0.5, 2.0, 1e6])
def test_a_violation_that_does_not_add_up_is_named(
    infeasible: tuple[Mission, Solution], figure: str, factor: float
) -> None:
    """Of the whole or of one constraint."""
    case, found = infeasible
    parts = found.violation.by_constraint
    assert {part.unit for part in parts.values()} == {"m", "m/s"}
    for name in (None, *parts):

        def damage(content: dict[str, Any], name: str | None = name) -> None:
            whole = content["violation"]
            inside = whole if name is None else whole["by_constraint"][name]
            inside[figure] *= factor

        assert inconsistencies(case, changed(found, damage)) == ["violation"]


@pytest.mark.parametrize("figure", ["max", "total"])
@pytest.mark.parametrize("factor", [1.0 - 1e-6, 1.0 + 1e-6])
def test_a_violation_of_the_whole_is_that_of_the_parts_but_for_rounding(
    infeasible: tuple[Mission, Solution], figure: str, factor: float
) -> None:
    def damage(content: dict[str, Any]) -> None:
        content["violation"][figure] *= factor

    case, found = infeasible
    assert inconsistencies(case, changed(found, damage)) == ["violation"]


def test_a_total_beyond_what_the_margins_leave_is_named(
    infeasible: tuple[Mission, Solution],
) -> None:
    case, found = infeasible

    def damage(content: dict[str, Any]) -> None:
        """Tenfold, in the whole too, so that the sums agree."""
        whole = content["violation"]
        for part in whole["by_constraint"].values():
            part["total"] *= 10.0
        whole["total"] *= 10.0

    assert inconsistencies(case, changed(found, damage)) == ["violation"]


def other_unit(data: dict[str, Any]) -> None:
    for part in data["violation"]["by_constraint"].values():
        part["unit"] = {"m": "m/s", "m/s": "m"}[part["unit"]]


def test_a_violation_in_the_wrong_unit_is_named(infeasible: tuple[Mission, Solution]) -> None:
    case, found = infeasible
    assert inconsistencies(case, changed(found, other_unit)) == ["violation"]


@pytest.mark.parametrize(("error_s", "found"), [(1e-9, []), (-9e-4, []), (1.0, ["nodes.t_s"])])
def test_a_window_edge_is_held_against_the_tolerance_of_reading(
    mission: Mission, solution: Solution, error_s: float, found: list[str]
) -> None:
    def move(data: dict[str, Any]) -> None:
        data["nodes"]["t_s"][int(mission.window_nodes[0])] += error_s

    assert inconsistencies(mission, changed(solution, move)) == found


@pytest.mark.usefixtures("few_flights")
@pytest.mark.parametrize(
    ("override", "named"),
    [
        ("burns.dv_max_m_s=0.04", "dv_max"),
        ("battery.delta_v_cone_deg=80", "dv_battery"),
        ("safety.radius_min_m=800", "safety_radius"),
        ("observation.site_distance_max_m=560", "site_distance_max"),
        ("observation.site_distance_min_m=600", "site_distance_min"),
        ("observation.emission_min_deg=30", "emission_min"),
        ("observation.emission_max_deg=35", "emission_max"),
        ("observation.phase_min_deg=85", "phase_min"),
        ("observation.phase_max_deg=60", "phase_max"),
        ("battery.observation_cone_deg=85", "battery_observation"),
    ],
)
def test_each_constraint_that_the_plan_breaks_is_named(
    solution: Solution, override: str, named: str
) -> None:
    """The same plan under a stricter limit."""
    checked = verify(mission_of(override), solution)
    assert not checked.ok
    assert named in checked.failed


@pytest.mark.usefixtures("few_flights")
def test_a_probability_below_the_asked_one_is_named(solution: Solution) -> None:
    checked = verify(mission_of("risk.p_chance=0.99"), solution)
    assert "P(site_distance)" in checked.failed
    assert "P(emission)" in checked.failed
    assert "P(phase)" not in checked.failed


@pytest.mark.usefixtures("few_flights")
def test_more_uncertainty_than_planned_for_is_found_out(solution: Solution) -> None:
    checked = verify(mission_of("uncertainty.execution_error=0.16"), solution)
    assert "covariance_error" in checked.failed


@pytest.mark.usefixtures("few_flights")
def test_constraints_are_checked_between_the_nodes(mission: Mission, solution: Solution) -> None:
    """The same plan known only at its burns and the window's edges, where every limit is kept."""
    coarse = mission_of("grid.step_max_s=40000", "observation.emission_max_deg=38")
    keep = np.flatnonzero(np.isin(mission.times_s, coarse.times_s))

    def thin(data: dict[str, Any]) -> None:
        data["nodes"] = {
            name: [values[k] for k in keep.tolist()] for name, values in data["nodes"].items()
        }

    thinned = changed(solution, thin)
    assert len(thinned.nodes.t_s) == 6
    for k in coarse.window_nodes:
        time, position = thinned.nodes.t_s[k], np.array(thinned.nodes.state[k][:3])
        to_j2000 = mission.rotation.body_to_j2000(time)
        offset = position - to_j2000 @ mission.site.position_body
        cosine = offset @ to_j2000 @ mission.site.normal_body / np.linalg.norm(offset)
        assert np.rad2deg(np.arccos(cosine)) < 37.9
    checked = verify(coarse, thinned)
    # The facets of the nodes that are gone are nobody's any more.
    assert checked.failed == ["facets", "emission_max", "P(emission)"]
    (margin,) = (m for m in checked.mean_margins if m.name == "emission_max")
    (probability,) = (p for p in checked.probabilities if p.name == "emission")
    for time in (margin.worst_t_s, probability.worst_t_s):
        assert 13_200.0 < time < 16_500.0


# --- its own tools ------------------------------------------------------------------------------


@given(
    state=st.tuples(*[st.floats(-900.0, 900.0)] * 3).map(np.array).filter(lambda r: r @ r > 9e4),
    seed=st.integers(0, 100),
)
def test_variational_rate_is_the_jacobian_of_the_dynamics(
    state: Array, seed: int, mission: Mission
) -> None:
    rng = np.random.default_rng(seed)
    velocity, stm = rng.normal(scale=0.1, size=3), rng.normal(size=(6, 6))
    rate = variational_rate(np.concatenate([state, velocity, stm.ravel()]), mission.forces)
    value, gradient = (
        acceleration(*state, mission.forces),
        gravity_gradient(state[None], mission.forces),
    )
    jacobian = np.block([[np.zeros((3, 3)), np.eye(3)], [gradient[0], np.zeros((3, 3))]])
    np.testing.assert_allclose(rate[:6], [*velocity, *value], rtol=1e-12)
    np.testing.assert_allclose(rate[6:].reshape(6, 6), jacobian @ stm, rtol=1e-11, atol=1e-15)


def test_verification_is_repeatable(
    mission: Mission, solution: Solution, verification: Verification
) -> None:
    assert verify(mission, solution) == verification
