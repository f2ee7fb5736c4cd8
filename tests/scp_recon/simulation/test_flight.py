import json
from dataclasses import replace

import numpy as np
import pytest

pytest.importorskip("Basilisk", reason="needs the extra [sim]")

from hypothesis import given
from hypothesis import strategies as st

from formulations.arrays import Array
from scp_recon.cli.commands import simulate as command
from scp_recon.mission.schedule import Mode
from scp_recon.physics.frames import unit
from scp_recon.results.policy import Correction
from scp_recon.simulation.basilisk import simulation
from scp_recon.simulation.basilisk.simulation import (
    Draws,
    Simulator,
    Source,
    Start,
    sensor_sigmas,
    simulate,
)
from scp_recon.simulation.flight import Actuators, Flight, distribute
from scp_recon.simulation.guidance import FlightPlan
from scp_recon.simulation.record import ARRAYS, FILE_NAME, make_record, read_record, write_record
from tests.helpers import nightly
from tests.scp_recon.simulation.short_plan import SHORT, short_plan
from tests.scp_recon.support import mission_of, sigma_of

pytestmark = pytest.mark.slow

PATH = frozenset({Source.INITIAL_STATE, Source.CHEMICAL_THRUSTER})


@pytest.fixture(scope="module")
def perfect(short_solution, vehicle) -> Flight:
    """The short plan flown without errors."""
    return simulate(short_solution, vehicle, sources=())


def test_flight_without_errors_stays_with_the_plan(perfect, short_solution):
    """Gravity's share over the few seconds of a burn is taken from the coast before."""
    error = perfect.node_states(short_solution) - np.array(short_solution.nodes.state)
    assert np.linalg.norm(error[:, :3], axis=1).max() < 3.0
    burns = perfect.burns_m_s - short_solution.burns_m_s
    assert (np.linalg.norm(burns, axis=1) < 0.01 * 0.045).all()
    assert (perfect.sigma_distance(short_solution) < 0.3).all()
    k = round(perfect.plan.firings[1].start_s)
    seconds = round(perfect.plan.firings[1].duration_s)
    coast = perfect.states[k, 3:] - perfect.states[k - seconds, 3:]
    gain = perfect.states[k + seconds, 3:] - perfect.states[k, 3:] - coast
    np.testing.assert_allclose(gain, perfect.burns_m_s[1], atol=3e-6)


def test_last_burn_may_be_longer_than_planned(perfect):
    """Its end is not recorded; the burn is whole, along the attitudes that are."""
    burns = np.array([firing.dv_m_s for firing in perfect.plan.firings])
    burns[-1] *= 3.0
    plan = perfect.plan.with_burns(burns)
    assert plan.end_s > perfect.times_s[-1]
    found = replace(perfect, plan=plan).burns_m_s
    np.testing.assert_allclose(found[0], perfect.burns_m_s[0], rtol=1e-12)
    np.testing.assert_allclose(found[-1], 3.0 * perfect.burns_m_s[-1], atol=1e-3 * 0.1)


def test_every_mode_settles_on_wheels(perfect, short_solution):
    error, summary = perfect.attitude_error, make_record(perfect, short_solution, 0).summary
    for leg in perfect.plan.legs[1:]:
        k = np.flatnonzero((perfect.times_s >= leg.start_s) & (perfect.times_s < leg.end_s))
        if leg.mode is not Mode.OBSERVATION and error[k[0]] > 0.2:
            assert perfect.in_use[k[1]] == Actuators.THRUSTERS
        before_burn = k[-20]
        assert perfect.in_use[before_burn] == Actuators.WHEELS
        assert error[before_burn] < np.deg2rad(0.3)
    assert summary.window_pointing_deg.camera.q100 < 0.3
    # The flight stays within three metres of the nominal path that the commands follow.
    assert summary.window_pointing_deg.site.q100 < 0.3 + np.rad2deg(3.0 / 500.0)
    assert np.deg2rad(summary.estimate_deg.q100) < 1e-6
    np.testing.assert_allclose(np.linalg.norm(perfect.attitudes.as_quat(), axis=1), 1.0, atol=1e-12)


def corrected(gain: float, cut_off_s: float) -> Correction:
    """The last burn corrected by what is measured, taken as it is."""
    return Correction(
        burn=1,
        cut_off_s=cut_off_s,
        measurement_covariance=np.eye(6),
        estimate_covariance=np.eye(6),
        gains=np.hstack([np.zeros((3, 3)), gain * np.eye(3)])[None],
    )


@nightly
def test_burn_is_commanded_from_state_at_cut_off(vehicle):
    """With the length and the attitude of the corrected burn; what was before stays."""
    mission = mission_of(*SHORT, "grid.nodes_s=[2600.0]")
    solution, sources = short_plan(mission), {Source.INITIAL_STATE}
    policy = (corrected(40.0, 2600.0),)
    flight = simulate(solution, vehicle, 1, sources=sources, policy=policy)
    node = int(np.searchsorted(mission.times_s, 2600.0))
    off = flight.states[2600, 3:] - np.array(solution.nodes.state[node][3:])
    expected = solution.burns_m_s[1] + 40.0 * off
    firing = flight.plan.firings[1]
    np.testing.assert_allclose(firing.dv_m_s, expected, rtol=1e-3, atol=1e-7)
    assert np.linalg.norm(40.0 * off) > 0.005
    thrust = vehicle.chemical_thruster.thrust_n / vehicle.mass.mass_kg
    assert firing.duration_s == np.ceil(np.linalg.norm(expected) / thrust)
    np.testing.assert_allclose(flight.burns_m_s[1], expected, atol=0.01 * np.linalg.norm(expected))
    assert make_record(flight, solution, 1).summary.burns[1].pointing_deg < 0.3
    assert not np.array_equal(firing.dv_m_s, solution.burns_m_s[1])
    np.testing.assert_array_equal(flight.plan.firings[0].dv_m_s, solution.burns_m_s[0])
    planned = FlightPlan.of(solution, mission, vehicle).attitudes(flight.times_s[:2600])
    assert (planned.inv() * flight.commands[:2600]).magnitude().max() == 0.0


def test_cut_off_precedes_burn_by_control_period(short_mission):
    """The state is taken along to the cut-off."""
    burns = np.zeros((2, 3))
    policy = (corrected(2.0, 3270.0),)
    commander = simulation.Commander(short_mission, burns, policy, np.zeros((1, 6)))
    assert commander.stops_s == [3269.0]
    seen: list[Array] = []
    commander._loop.measure = seen.append  # type: ignore[method-assign]
    commander._loop.correction = lambda _: np.ones((1, 3))  # type: ignore[method-assign]
    state = np.array([100.0, 200.0, 300.0, 0.1, 0.2, 0.3])
    np.testing.assert_array_equal(commander.burns_m_s(state), [[0.0] * 3, [1.0] * 3])
    expected = [100.1, 200.2, 300.3, 0.1, 0.2, 0.3]
    np.testing.assert_allclose(seen[0][:, 0], expected, rtol=1e-12)


def test_energy_ledger_closes_through_empty_and_full(perfect, vehicle):
    """Panels and batteries so small that these are emptied and filled again."""
    panels = [
        panel.model_copy(update={"area_m2": 0.28 * panel.area_m2}) for panel in vehicle.panels.panel
    ]
    weak = {
        "panels": vehicle.panels.model_copy(update={"panel": tuple(panels)}),
        "battery": vehicle.battery.model_copy(update={"capacity_wh": 2.0}),
    }
    power = replace(
        perfect, plan=replace(perfect.plan, vehicle=vehicle.model_copy(update=weak))
    ).power
    stored = power.stored_wh
    assert abs(power.ledger_error) < 1e-6
    assert stored.min() == pytest.approx(0.0, abs=1e-6)
    assert stored.max() == pytest.approx(2.0, abs=1e-6)
    assert min(power.short_w.max(), power.unused_w.max()) > 1.0
    # The first battery is emptied before the second, and filled after it.
    assert (stored[:, 0] <= stored[:, 1] + 1e-9).all()
    behind = -500.0 * perfect.plan.mission.sun_direction(perfect.times_s)
    assert not replace(perfect, states=behind).power.panels_w.any()


@given(
    net=st.floats(-1e3, 1e3),
    room=st.lists(st.floats(0.0, 500.0), min_size=1, max_size=4),
    efficiency=st.floats(0.5, 1.0),
    data=st.data(),
)
def test_the_bus_keeps_all_energy(net, room, efficiency, data):
    limits = st.lists(st.floats(0.0, 500.0), min_size=len(room), max_size=len(room))
    charge = np.array(data.draw(limits))
    stored, lost, unused, short = distribute(net, np.array(room), charge, efficiency)
    assert net + short == pytest.approx(stored.sum() + lost + unused, abs=1e-9)
    assert (stored <= np.array(room) + 1e-9).all()
    assert (stored >= -charge - 1e-9).all()
    assert min(lost, unused, short) >= -1e-9
    assert unused == 0.0 or short == 0.0


def test_omitted_source_leaves_other_draws(short_solution, short_mission, vehicle):
    plan = FlightPlan.of(short_solution, short_mission, vehicle)
    sigma, factor = sigma_of(short_mission), short_mission.initial_factor
    every = Draws.of(plan, factor, 100, 5, frozenset(Source))
    assert np.abs(every.initial / sigma).max() < 5.0
    assert every.pulses.std() == pytest.approx(vehicle.errors.micro_thruster_n, rel=0.15)
    for source in Source:
        one = Draws.of(plan, factor, 100, 5, {source})
        rest = Draws.of(plan, factor, 100, 5, frozenset(Source) - {source})
        for name in ("initial", "burns", "pulses"):
            whole, own, others = (getattr(draws, name) for draws in (every, one, rest))
            np.testing.assert_array_equal(whole, own + others)
    assert sensor_sigmas(vehicle.errors, {Source.IMU}).star_tracker == 0.0
    assert sensor_sigmas(vehicle.errors, {Source.IMU}).gyro == vehicle.errors.imu_rad_s


def short_run(
    whole: FlightPlan,
    seconds: int,
    sources: frozenset[Source],
    *,
    seed: int = 1,
    burns: int = 1,
    turning: bool = False,
    begin: int = 0,
    speeds: tuple[float, ...] = (0.0, 0.0, 0.0, 0.0),
    factor: Array | None = None,
) -> Simulator:
    """The first minutes, with the attitude of a second, turning or not, and wheels that spin."""
    mission, plan = whole.mission, replace(whole, firings=whole.firings[:burns])
    times = np.arange(float(seconds))
    commands = whole.attitudes(times)
    rate = (commands[0].inv() * commands[1]).as_rotvec() * turning
    own = np.zeros((6, 6)) if factor is None else factor
    draws = Draws.of(plan, own, seconds, seed, sources)
    state = mission.initial_state + draws.initial
    start = Start(state, commands[begin], rate, np.array(speeds))
    sim = Simulator(plan, commands, start, draws, times)
    sim.run()
    return sim


def test_momentum_is_dumped_and_the_attitude_kept(short_solution, short_mission, vehicle):
    """Wheels near their largest speed, with a net momentum, when sun-pointing begins."""
    plan = FlightPlan.of(short_solution, short_mission, vehicle)
    spinning = (205.0, -57.0, -157.0, 105.0)
    sim = short_run(plan, 500, frozenset(Source), burns=2, begin=100, speeds=spinning)
    speeds = sim.plant.wheels.rwSpeedOutMsg.read().wheelSpeeds[:4]
    axes = np.array(vehicle.wheels.axes) / np.sqrt(2.0)
    limit = vehicle.wheels.dump_end * vehicle.wheels.speed_max_rad_s
    assert sim.allocator.dumps == 1
    assert not sim.allocator.dumping
    assert np.linalg.norm(speeds @ axes) < 1.2 * limit
    assert (sim.allocator.in_use == Actuators.BOTH).sum() > 20
    estimate = sim.navigator.filter.mrp
    wanted = sim.navigator.commands[499].as_mrp()
    assert np.abs(estimate - wanted).max() < 0.02


def test_a_burn_of_zero_is_no_burn(short_solution, short_mission, vehicle):
    nothing = replace(short_solution.burns[0], dv_m_s=(0.0, 0.0, 0.0))
    solution = replace(short_solution, burns=[nothing, short_solution.burns[1]])
    flight = short_run(FlightPlan.of(solution, short_mission, vehicle), 30, frozenset()).flight()
    assert not flight.burns_m_s.any()
    drift = flight.states[-1, :3] - short_mission.initial_state[:3]
    expected = 29.0 * short_mission.initial_state[3:]
    np.testing.assert_allclose(drift, expected, atol=0.01)


def test_no_burn_follows_one_that_is_missed(
    perfect, short_solution, vehicle, tmp_path, monkeypatch
):
    monkeypatch.setattr(simulation, "reach_s", lambda _: 1_000.0)
    flight = simulate(short_solution, vehicle, sources=(), miss=2)
    assert flight.times_s[-1] == 4_270.0
    assert not flight.burns_m_s[1].any()
    np.testing.assert_allclose(flight.states[3_000], perfect.states[3_000], atol=0.05)
    record = make_record(flight, short_solution, 0)
    distance = np.linalg.norm(flight.states[3_270:, :3], axis=1)
    assert record.summary.drift.closest_m == distance.min()
    assert record.summary.drift.drift_s == 1_000.0
    assert write_record(record, tmp_path).name == "simulation_miss_2.npz"


def test_first_burn_goes_as_drawn(perfect, short_solution, short_mission, vehicle):
    """Of the first minute, off the one without errors by what was drawn for state and burn."""
    plan, factor = (
        FlightPlan.of(short_solution, short_mission, vehicle),
        short_mission.initial_factor,
    )
    flight = short_run(plan, 60, PATH, seed=3, factor=factor).flight()
    firing = plan.firings[0]
    draws = Draws.of(replace(plan, firings=plan.firings[:1]), factor, 60, 3, PATH)
    kick = draws.burns[0] * firing.dv_m_s
    assert np.linalg.norm(kick) > 1e-4
    off = (flight.states - perfect.states[:60])[-1]
    np.testing.assert_allclose(off[3:], draws.initial[3:] + kick, atol=6e-5)
    moved = draws.initial[:3] + 59.0 * draws.initial[3:]
    moved += (59.0 - 0.5 * firing.duration_s) * kick
    np.testing.assert_allclose(off[:3], moved, atol=5e-3)


def test_pulses_that_err_move_the_end(perfect, short_solution, short_mission, vehicle):
    """The first slew, with a tenth of the thrust as error; without it nothing changes at all."""
    ends = []
    for sigma in (0.0, 0.1 * vehicle.micro_thrusters.thrust_n):
        errors = vehicle.errors.model_copy(update={"micro_thruster_n": sigma})
        other = vehicle.model_copy(update={"errors": errors})
        whole = FlightPlan.of(short_solution, short_mission, other)
        sim = short_run(whole, 400, frozenset({Source.MICRO_THRUSTER}), seed=0, turning=True)
        state = sim.plant.hub.scStateOutMsg.read()
        ends.append(np.array([*state.r_CN_N, *state.v_CN_N]))
    np.testing.assert_allclose(ends[0], perfect.states[399], rtol=0.0, atol=1e-9)
    assert np.linalg.norm((ends[1] - ends[0])[:3]) > 1e-3
    assert np.linalg.norm((ends[1] - ends[0])[3:]) > 1e-5


def test_torques_are_those_that_turn_the_body(perfect, short_solution):
    """The thrusters' is the change of all momentum in J2000, but for burns, light and gravity."""
    plan, wheels = perfect.plan, perfect.plan.vehicle.wheels
    spin = wheels.inertia_kg_m2 * perfect.wheel_speeds_rad_s @ unit(wheels.axes)
    body = perfect.rates_rad_s * plan.vehicle.mass.inertia_kg_m2
    momentum = perfect.attitudes.apply(spin + body)
    gained = perfect.attitudes.apply(perfect.thruster_torque)[:-1]
    burning = [
        (perfect.times_s >= f.start_s - 1.0) & (perfect.times_s <= f.end_s + 1.0)
        for f in plan.firings
    ]
    off = np.linalg.norm(np.diff(momentum, axis=0) - gained, axis=1)
    off = off[~np.logical_or.reduce(burning)[:-1]]
    assert off.max() < 0.15 * np.linalg.norm(gained, axis=1).max()  # it turns within the second
    arrays = make_record(perfect, short_solution, 0).arrays
    for name, torque in (("thruster", perfect.thruster_torque), ("wheel", perfect.wheel_torque)):
        whole = len(torque) // 10 * 10
        kept = arrays[f"{name}_torque_n_m"][: whole // 10]
        np.testing.assert_allclose(kept, torque[:whole].reshape(-1, 10, 3).mean(axis=1), atol=1e-15)
    np.testing.assert_allclose(np.diff(spin, axis=0), -perfect.wheel_torque[:-1], atol=1e-12)


def test_a_record_is_read_as_it_was_written(perfect, short_solution, tmp_path):
    record = make_record(perfect, short_solution, 0)
    assert set(record.arrays) == set(ARRAYS)
    write_record(record, tmp_path)
    again = read_record(tmp_path)
    assert again.summary == record.summary
    assert again.plan_hash == short_solution.plan_hash
    for name in ARRAYS:
        np.testing.assert_array_equal(again.arrays[name], record.arrays[name])


def test_command_writes_one_file(perfect, short_solution, tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(simulation, "simulate", lambda *_, **__: perfect)
    short_solution.write(tmp_path)
    assert (
        command.main([str(tmp_path), "--seed", "7", "--out", str(tmp_path / "out"), "--json"]) == 0
    )
    said = capsys.readouterr()
    assert "within 3 sigma" in said.err
    document = json.loads(said.out)
    assert (document["command"], document["status"]) == ("simulate", 0)
    assert document["summary"]["terminal_miss"]["position_m"] > 0.0
    assert [path.name for path in (tmp_path / "out").iterdir()] == [FILE_NAME]
    summary = read_record(tmp_path / "out").summary
    assert (summary.seed, summary.least_charge > 0.3) == (7, True)


def test_negative_seed_is_refused_before_progress(short_solution, tmp_path, capsys):
    assert command.main([str(short_solution.write(tmp_path)), "--seed", "-1"]) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert "--seed" in line
