"""Forces besides J2 and light: a second body, and harmonics that turn with the first.

The second one pulls as Newton says, and flights keep out of a ball that moves with it.
"""

from dataclasses import replace

import casadi as ca
import numpy as np
import pytest
from scipy.integrate import solve_ivp

from formulations.arrays import Array
from formulations.problem.regions import Ball
from scp_recon.errors import InputError
from scp_recon.mission.constraints import COMPANION as NAME
from scp_recon.mission.mission import Mission
from scp_recon.monte_carlo.flights import fly_many
from scp_recon.monte_carlo.sampling import Flyer
from scp_recon.monte_carlo.whole_flight import SampledFlights, kept_flights
from scp_recon.physics.flow import propagate
from scp_recon.physics.forces import accelerations
from scp_recon.planning.initial_guess import ballistic
from scp_recon.planning.ipopt import casadi_arcs
from scp_recon.planning.planner import plan
from scp_recon.reports.tables import limits_table
from scp_recon.results.solution import make_solution
from scp_recon.verification.reintegration import verify
from tests.helpers import nightly
from tests.scenarios import COARSE
from tests.scp_recon.bodies.test_kernels import GFC
from tests.scp_recon.support import COMPANION, integrate, mission_of


def test_the_companion_obeys_three_body_motion():
    """Newton's law for three bodies in an inertial frame, with none of the library's arithmetic."""
    mission = mission_of().changed({"body.companion": COMPANION})
    forces = replace(mission.forces, j2_strength=0.0, srp=np.zeros(3))
    other, state = mission.scene.companion, mission.initial_state
    assert other is not None
    gms, step = np.array([forces.gm, other.gm, 0.0]), 1.0
    moving = (other.position(step) - other.position(-step)) / (2.0 * step)
    start = np.array(
        [[np.zeros(3), other.position(0.0), state[:3]], [np.zeros(3), moving, state[3:]]]
    )

    def rate(_: float, y: Array) -> Array:
        r, v = y.reshape(2, 3, 3)
        apart = r[:, None] - r
        far = np.linalg.norm(apart, axis=2) + np.eye(3)
        return np.concatenate(
            [v.ravel(), -np.einsum("j,ijk->ik", gms, apart / far[..., None] ** 3).ravel()]
        )

    end = solve_ivp(rate, (0.0, 20_000.0), start.ravel(), "DOP853", rtol=1e-12, atol=1e-9).y[:9, -1]
    body, second, craft = end.reshape(3, 3)
    # The period is that of the semi-major axis to 1e-6.
    assert other.position(20_000.0) == pytest.approx(second - body, abs=0.02)
    flown = integrate(forces, state, [0.0, 20_000.0])[-1]
    alone = integrate(forces.autonomous, state, [0.0, 20_000.0])[-1]
    assert np.linalg.norm(flown[:3] - (craft - body)) < 0.05
    assert np.linalg.norm(alone[:3] - (craft - body)) > 10.0


def in_the_way(*overrides: str) -> Mission:
    """The companion where the default plan passes at 25000 s, 250 m to keep from its centre."""
    orbit = {"semi_major_axis_m": 1000.0, "eccentricity": 0.0, "period_h": 24.90673}
    pole = {"pole_ra_deg": 184.9, "pole_dec_deg": 0.0, "gm_m3_s2": 0.02}
    since = {"epoch_tdb": "2020-01-22T03:29:57", "mean_anomaly_deg": 5.8, "periapsis_deg": 0.0}
    entries = {"body.companion": COMPANION | orbit | pole | since}
    return mission_of(COARSE, "safety.companion_distance_min_m=250", *overrides).changed(entries)


EXACT, FLIGHT = "risk.allocation=exact", "risk.scope=flight"


@pytest.mark.slow
@pytest.mark.parametrize(
    "overrides",
    [(EXACT,), *(pytest.param(rest, marks=nightly) for rest in ((), (EXACT, FLIGHT)))],
    ids=str,
)
@pytest.mark.usefixtures("few_flights")
def test_a_plan_keeps_out_of_the_moving_ball(overrides):
    mission = in_the_way(*overrides)
    planned = plan(mission, ballistic(mission))
    checked = verify(mission, make_solution(planned))
    assert checked.ok, checked.failed
    (margin,) = (m for m in checked.mean_margins if m.name == NAME)
    assert 0.0 < margin.worst_margin < 20.0  # it binds
    (chance,) = (p for p in checked.probabilities if p.name == NAME)
    assert chance.low < 1.0
    assert chance.high > 0.7
    flights = SampledFlights(mission.changed({"risk.scope": "node"}), planned.burns_m_s)
    _, holds = flights.judged(flights.draws(0)[:200]).kept[NAME]
    assert holds.mean(axis=1).min() == pytest.approx(chance.estimate, abs=0.1)


def test_flights_through_the_ball_are_counted_as_lost(default_plan):
    counts = []
    for mission in (mission_of(COARSE), in_the_way()):
        flown = fly_many(Flyer(mission, default_plan.burns_m_s), samples=200)
        whole = mission.changed({"risk.scope": "flight", "risk.allocation": "exact"})
        kept = kept_flights(SampledFlights(whole, default_plan.burns_m_s), 200)
        counts.append((flown.whole, kept.throughout))
    assert min(counts[0]) > 150
    assert max(counts[1]) < 10
    assert flown.node_counts[NAME].min() < 10


def test_the_default_distance_is_the_companions_radius():
    mission = mission_of().changed({"body.companion": COMPANION})
    (found,) = (c for c in mission.problem.constraints if c.name == NAME)
    assert isinstance(found.region, Ball)
    assert found.region.radius * mission.units.length_m == pytest.approx(60.0)


@pytest.mark.parametrize(
    ("changes", "entry"),
    [
        ({"period_h": 30.0}, "body.companion.period_h"),
        ({"semi_major_axis_m": 300.0, "period_h": 4.0803}, "body.companion.semi_major_axis_m"),
        ({"epoch_tdb": "2020-01-20T00:00:00Z"}, "body.companion.epoch_tdb"),
    ],
)
def test_an_orbit_that_cannot_be_is_refused(changes, entry):
    with pytest.raises(InputError) as refused:
        mission_of().changed({"body.companion": COMPANION | changes})
    assert refused.value.entry == entry


DEGREE = "body.planned_degree"


@nightly
@pytest.mark.slow
@pytest.mark.usefixtures("few_flights")
def test_a_plan_with_harmonics_is_verified():
    mission = mission_of(f"{DEGREE}=3")
    solution = make_solution(plan(mission, ballistic(mission)))
    checked = verify(mission, solution)
    assert checked.ok, checked.failed
    assert "harmonics to degree 3" in limits_table(mission, solution, checked).note


def test_the_whole_field_equals_the_true_field(default_plan):
    j2, turning = default_plan.mission, mission_of(f"{DEGREE}=8")
    planner, truth, before = (
        Flyer(each, default_plan.burns_m_s, truth=field)
        .fly_block(each.times_s, 0, flights=3)
        .states[-1]
        for each, field in ((turning, "planner"), (turning, "harmonics"), (j2, "planner"))
    )
    np.testing.assert_array_equal(planner, truth)
    assert np.linalg.norm((planner - before)[:, :3], axis=1).min() > 0.1  # m, that J2 leaves out


@pytest.mark.parametrize("entries", [{DEGREE: 4}, {"body.companion": COMPANION}], ids=str)
def test_arcs_over_symbols_are_the_planners(entries):
    mission = mission_of(COARSE).changed(entries)
    flow, starts = mission.flow, ballistic(mission).mean[:-1]
    arcs = casadi_arcs(flow)
    ends = np.array(arcs.flow.map(len(starts))(starts.T, ca.DM(arcs.durations).T)).T
    assert ends == pytest.approx(flow.differentiate(starts).state, rel=1e-12, abs=1e-13)
    assert ends[3] == pytest.approx(flow.propagate(starts[3], 3), rel=1e-12)


@pytest.mark.parametrize(
    ("overrides", "given"),
    [
        ((f"{DEGREE}=9",), "9"),
        ((f"{DEGREE}=4", "body.gm_m3_s2=4.0"), "body.gm_m3_s2 4"),
        ((f"{DEGREE}=4", 'body.gravity_file="{field}"'), "4"),
    ],
)
def test_missing_degrees_of_the_field_are_refused(overrides, given, tmp_path):
    field = tmp_path / "field.gfc"
    field.write_text(GFC, "utf-8")
    with pytest.raises(InputError) as refused:
        mission_of(*(each.format(field=field) for each in overrides))
    assert (refused.value.entry, refused.value.given) == (DEGREE, given)


def test_forces_that_turn_need_a_time():
    turning = mission_of(f"{DEGREE}=2")
    state = turning.initial_state
    with pytest.raises(ValueError, match="arcs start"):
        propagate(state, 1.0, turning.forces)
    with pytest.raises(ValueError, match="surroundings"):
        accelerations(state[:3, None], turning.forces)
