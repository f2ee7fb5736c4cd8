"""Uncertain parameters: columns of the factor, motions of regions, rows, and refusals."""

from dataclasses import replace
from functools import cache
from typing import Any

import numpy as np
import pytest

from formulations.arrays import Array
from formulations.linearisation.linearisation import Linearisation, condense
from formulations.problem.facets import choose_facets
from formulations.problem.regions import Ball, Motion, relative, with_parameters
from formulations.program.lifted import LiftedSubproblem
from formulations.registry import make_subproblem
from formulations.rows.exact import NodeRows
from formulations.rows.exact_flight import FlightRows
from formulations.rows.node_probability import Event, moving_quantiles
from formulations.rows.uniform import ChanceRows
from scp_recon.mission.knowledge import Uncertain, in_words
from scp_recon.mission.mission import Mission
from scp_recon.physics.flow import GridFlow
from scp_recon.physics.forces import STEP, ForceModel, Partials
from scp_recon.physics.geometry import track
from scp_recon.planning.initial_guess import from_burns
from scp_recon.scenario.load import load_scenario
from tests.formulations.program.support import assert_transposed
from tests.helpers import usually
from tests.scp_recon.support import COMPANION, refusal

pytestmark = pytest.mark.slow

COARSE: dict[str, Any] = {"grid.step_max_s": 600.0}
EVERYTHING: dict[str, Any] = {
    "body": {
        "gm_m3_s2": 0.05,
        "j2": 0.002,
        "pole_ra_deg": 1.0,
        "pole_dec_deg": 0.5,
        "prime_meridian_deg": 2.0,
        "prime_meridian_rate_deg_day": 0.5,
    },
    "spacecraft": {"reflectivity_coefficient": 0.1, "srp_area_m2": 0.1},
    "site": {"position_body_m": [2.0, 3.0, 1.0], "normal_body": [0.02, 0.02, 0.01]},
}
"""Of Bennu's approach: 14 numbers."""
WITH_COMPANION = EVERYTHING | {
    "body": EVERYTHING["body"] | {"companion": {"gm_m3_s2": 0.005, "mean_anomaly_deg": 3.0}}
}
BURNS = 1e-4 * np.array([[-100, 516, 170], [-58, 181, -81], [-37, 6, -99], [-103, 379, 40]])
"""Those of the default plan, about, m/s."""


@cache
def mission_with(name: str) -> Mission:
    """The default scenario on a coarse grid, everything uncertain; with harmonics and a companion."""
    changes: dict[str, Any] = {"plain": {}, "field": {"body.planned_degree": 3}}[name]
    known = EVERYTHING
    if name == "field":
        changes, known = changes | {"body.companion": COMPANION}, WITH_COMPANION
    return Mission.from_scenario(
        load_scenario().replace({**COARSE, **changes}).replace({"knowledge": known})
    )


def flown(mission: Mission, burns: Array = BURNS) -> Linearisation:
    return mission.dynamics.linearise(mission.problem, from_burns(mission, burns))


@pytest.mark.parametrize("name", ["plain", "field"])
def test_columns_are_derivatives_of_deviating_flights(name):
    """A number's column at every node, by central differences of the nonlinear flow.

    With harmonics and a companion, of the usual day's numbers only the last ones that act.
    """
    mission = mission_with(name)
    lin, step = flown(mission), 1e-3
    start, burns, count = mission.problem.initial_state, lin.iterate.burns, mission.uncertain.count
    acting = np.abs(lin.factor[:, :, 6 : 6 + count]).max(axis=(0, 1)) > 0.0
    assert acting.sum() == (6 if name == "plain" else 10)
    numbers = range(count) if name == "plain" else usually(np.flatnonzero(acting)[::-1], 4)
    for k in numbers:
        move = step * np.eye(count)[k]
        ends = [
            mission.deviating(mission.uncertain.deviation(s * move)).dynamics.rollout(start, burns)
            for s in (1.0, -1.0)
        ]
        expected = (ends[0] - ends[1]) / (2.0 * step)
        column = lin.factor[:, :, 6 + k]
        assert np.abs(column - expected).max() <= 1e-6 * max(1e-3, np.abs(expected).max())


@pytest.mark.parametrize("name", ["plain", "field"])
def test_factor_has_derivatives_by_burns(name):
    """With the mixed second derivatives: to 1e-6 of the largest."""
    mission, rng = mission_with(name), np.random.default_rng(2)
    lin, direction, step = flown(mission), rng.normal(size=(4, 3)), 1e-5
    speed = mission.units.speed_m_s
    ends = [flown(mission, BURNS + s * step * speed * direction).factor for s in (1.0, -1.0)]
    expected = (ends[0] - ends[1]) / (2.0 * step)
    found = condense(lin).factor_jacobian @ direction.ravel()
    own = slice(6, 6 + mission.uncertain.count)
    assert_transposed(lin, rng)
    for part in (slice(None), own):
        apart = np.abs(found - expected)[..., part].max()
        assert apart <= 1e-6 * np.abs(expected[..., part]).max()


def test_gm_error_drifts_along_a_circular_orbit():
    """With GM (1 + e) a circular start leads along the track by 2 e a (nt - sin nt), linearised."""
    forces = ForceModel(1.0, 0.0, np.array([0.0, 0.0, 1.0]), np.zeros(3))
    share, times = 0.01, np.linspace(0.0, 12.0, 241)
    sides = ((replace(forces, gm=1.0 + s * STEP * share),) for s in (1.0, -1.0))
    none = np.zeros(0, np.intp)
    partials = Partials(*sides, np.array([0]), (), none, forces, 1)
    flow = GridFlow(forces, times[:-1], np.diff(times), 1, partials)
    state, column = np.array([[1.0, 0, 0, 0, 1.0, 0]]), np.zeros(6)
    found = [0.0]
    for k in range(flow.arcs):
        one = replace(
            flow, starts=flow.starts[k : k + 1], durations=flow.durations[k : k + 1]
        ).differentiate(state)
        column = one.stm[0] @ column + one.by_parameters[0, :, 0]
        state = one.state
        found.append(float(column[:3] @ (state[0, 3:] / np.linalg.norm(state[0, 3:]))))
    expected = 2.0 * share * (times - np.sin(times))
    np.testing.assert_allclose(found, expected, atol=1e-6)


def test_hover_over_an_uncertain_site_is_normal():
    """A still spacecraft d above a site of uncertain height: the distance is d, 1 sigma of it s."""
    d, most, s = 3.0, 3.2, 0.1
    ball = Event("distance", np.zeros(1, np.intp), (Ball(np.zeros((1, 3)), most),), ())
    shift = np.zeros((1, 3, 1))
    shift[0, 2, 0] = s
    moving = replace(ball, motion=Motion(np.zeros((1, 3)), shift, np.zeros((1, 3, 1))))
    above, still = np.array([[0.0, 0.0, d]]), np.zeros((1, 3, 7))
    parameters = np.eye(1, 7, 6)
    g = moving_quantiles(moving, above, still, parameters)
    assert g.value[0] == pytest.approx((most - d) / s, abs=2e-3)
    # Without the site's error the spacecraft is inside for certain.
    assert moving_quantiles(ball, above, still, parameters).value[0] > 6.0


def test_spin_phase_error_is_a_longitude_error():
    """A body turned by one sigma has the site where a site one sigma farther east is."""
    mission = Mission.from_scenario(
        load_scenario().replace({**COARSE, "knowledge.body.prime_meridian_deg": 1.0})
    )
    angle = np.deg2rad(1.0)
    turn = np.array(
        [[np.cos(angle), -np.sin(angle), 0], [np.sin(angle), np.cos(angle), 0], [0, 0, 1]]
    )
    times = mission.times_s[mission.window_nodes]
    one = mission.deviating(mission.uncertain.deviation(np.ones(1)))
    site = replace(
        mission.site,
        position_body=turn @ mission.site.position_body,
        normal_body=turn @ mission.site.normal_body,
    )
    turned, moved = track(one.site, one.rotation, times), track(site, mission.rotation, times)
    np.testing.assert_allclose(turned.position, moved.position, atol=1e-9)
    np.testing.assert_allclose(turned.normal, moved.normal, atol=1e-12)
    # The motion of the limits is the derivative of that.
    limit = next(c for c in mission.problem.constraints if c.event == "emission")
    assert limit.motion is not None
    shift = limit.motion.shift[:, :, 0] * mission.units.length_m
    east = np.cross(mission.rotation.pole, track(mission.site, mission.rotation, times).position)
    np.testing.assert_allclose(shift, angle * east, rtol=1e-6, atol=1e-6)


@pytest.mark.parametrize("kind", ["uniform", "node", "flight"])
def test_rows_have_derivatives_with_moving_regions(kind):
    """Slopes of margins by the burns, through parameters' columns and motions, by differences."""
    mission, rng = mission_with("plain"), np.random.default_rng(5)
    lin, problem = flown(mission), mission.problem
    if kind == "uniform":
        facets = choose_facets(problem, mission.polytopes, lin.iterate.mean, lin.spread.factor)
        rows: Any = ChanceRows(problem, facets, np.ones(len(facets.node), dtype=bool))
    else:
        rows = NodeRows(problem, 0.7) if kind == "node" else FlightRows(problem, 0.7, 512, 1e-5)
    direction, step = rng.normal(size=(4, 3)), 1e-5 if kind == "flight" else 1e-6
    s = condense(lin, rows.nodes, factor=rows.condensed)
    slope = np.zeros(rows.count)
    for cones in rows.cones(lin, s):
        d = cones.values @ direction.ravel()[: cones.values.shape[2]]
        y = cones.at(lin.controls)
        size = np.maximum(np.linalg.norm(y[:, 1:], axis=1), 1e-300)
        slope[cones.rows] = d[:, 0] - np.einsum("nd,nd->n", y[:, 1:], d[:, 1:]) / size

    def margins(sign: float) -> Array:
        moved = flown(mission, BURNS + sign * step * mission.units.speed_m_s * direction)
        return np.concatenate([part.margin for part in rows.margins(moved).values()])

    expected, here = (margins(1.0) - margins(-1.0)) / (2.0 * step), margins(0.0)
    near = np.abs(here) < 3.0 if kind == "node" else np.full(len(here), True)
    tolerance = {"uniform": 1e-6, "node": 1e-4, "flight": 2e-3}[kind]
    assert near.any()
    assert np.abs(slope - expected)[near].max() <= tolerance * np.abs(expected[near]).max()


@pytest.mark.parametrize("kind", ["uniform", "flight"])
def test_lifted_and_condensed_are_one_program(kind):
    mission = mission_with("plain")
    lin, problem = flown(mission), mission.problem
    if kind == "uniform":
        facets = choose_facets(problem, mission.polytopes, lin.iterate.mean, lin.spread.factor)
        rows: Any = ChanceRows(problem, facets, np.ones(len(facets.node), dtype=bool))
    else:
        rows = FlightRows(problem, 0.7, 256, 1e-5)
    merits = []
    for form in ("condensed", "lifted"):
        program = make_subproblem(problem, rows, form)
        program.update(lin)
        merits.append(program.solve(0.05, 10.0).merit)
    assert isinstance(program, LiftedSubproblem)
    assert merits[1] == pytest.approx(merits[0], rel=1e-5)


def test_known_parameters_change_no_digit():
    """A sigma of zero is no uncertainty, and without any the problem has no parameter."""
    scenario = load_scenario().replace(COARSE)
    plain = Mission.from_scenario(scenario)
    known = Mission.from_scenario(scenario.replace({"knowledge.body.gm_m3_s2": 0.0}))
    assert known.uncertain.count == 0
    assert known.partials is None
    one, other = flown(plain), flown(known)
    assert np.array_equal(one.factor, other.factor)
    assert np.array_equal(condense(one).factor_jacobian, condense(other).factor_jacobian)


def test_covariance_of_names_is_the_law():
    matrix = [[0.0025, 1e-5], [1e-5, 4e-6]]
    changes = {"knowledge": {"names": ["body.gm_m3_s2", "body.j2"], "covariance": matrix}}
    law = Uncertain.of(load_scenario().replace(changes))
    np.testing.assert_allclose(law.factor @ law.factor.T, matrix, rtol=1e-12)
    assert law.sigmas["body.gm_m3_s2"] == pytest.approx(0.05)


def test_shares_are_of_the_entries_values():
    words = in_words(load_scenario().replace({"knowledge": EVERYTHING}))
    assert "body.gm_m3_s2 0.05 (1.02 %)" in words
    assert "site.position_body_m 2, 3, 1;" in words


def test_relative_factors_have_the_parameters_rows():
    lin = flown(mission_with("plain"))
    factor = with_parameters(lin.spread.factor)
    assert factor.shape[1] == 3 + lin.problem.parameters
    still = relative(None, lin.iterate.mean[:, :3], factor)
    assert np.array_equal(still, lin.factor[:, :3])


def law(names: list[str], covariance: list[list[float]], **more: Any) -> dict[str, Any]:
    return {"knowledge": {"names": names, "covariance": covariance, **more}}


TWO, SPREAD = ["body.j2", "body.gm_m3_s2"], [[1e-6, 0.0], [0.0, 1e-4]]
BAD: list[tuple[dict[str, Any], str]] = [
    ({"knowledge.body.gm_m3_s2": -0.1}, "knowledge.body.gm_m3_s2"),
    ({"knowledge.body.mass_kg": 1.0}, "knowledge.body.mass_kg"),
    ({"knowledge.body.gm": 1.0}, "did you mean knowledge.body.gm_m3_s2?"),
    ({"knowledge.body.gm_m3_s2": 2.0}, "3 sigma reach zero"),
    ({"knowledge.body.companion.gm_m3_s2": 0.01}, "needs body.companion"),
    ({"knowledge.spacecraft.reflectivity_coefficient": 1.0}, "3 sigma"),
    ({"knowledge.body.pole_ra_deg": 40.0}, "at most 10 deg"),
    ({"knowledge.body.pole_dec_deg": 9.0, "body.pole_dec_deg": -80.0}, "pass J2000's pole"),
    ({"knowledge.body.prime_meridian_rate_deg_day": 100.0}, "in the flight"),
    ({"knowledge.site.normal_body": [0.3, 0.0, 0.0]}, "at most 0.1"),
    ({"knowledge.site.position_body_m": [90.0, 0.0, 0.0]}, "3 sigma reach zero"),
    ({"knowledge.site.position_body_m": [1.0, 2.0]}, "knowledge.site.position_body_m"),
    ({"knowledge.names": TWO}, "together"),
    (law(TWO, [[1.0, 3.0], [3.0, 1.0]]), "positive semidefinite"),
    (law(["body.j2", "body.gm"], SPREAD), "must be among"),
    (law(TWO, SPREAD, body={"j2": 1e-3}), "once"),
    ({"knowledge.body.j2": 0.4}, "|J2| <= 1"),
]


@pytest.mark.parametrize(("changes", "words"), BAD)
def test_bad_knowledge_is_refused_in_one_message(changes, words):
    error = refusal(lambda: Mission.from_scenario(load_scenario().replace(changes)))
    assert words in str(error)
    assert str(error).startswith("knowledge")


def test_companions_sigmas_are_set_in_one_override():
    scenario = load_scenario("didymos", ["knowledge.body.companion.gm_m3_s2=0.01"])
    assert Uncertain.of(scenario).sigmas == {"body.companion.gm_m3_s2": np.array([0.01])}
