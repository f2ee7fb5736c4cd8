"""Pictures of landmarks: what each cut-off knows, against dense least squares on nonlinear pictures."""

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from scipy.linalg import block_diag

import scp_recon
from formulations.arrays import Array
from scp_recon.mission.feedback import cut_offs_s, landmarks_m, picture_times_s
from scp_recon.mission.mission import Mission
from scp_recon.monte_carlo.closed_loop import replans
from scp_recon.planning.initial_guess import from_burns
from scp_recon.results.policy import SAME, misjudged
from scp_recon.results.solution import make_solution
from scp_recon.scenario.load import load_scenario
from scp_recon.verification.reintegration import verify
from tests.helpers import nightly
from tests.scp_recon.mission.test_knowledge import BURNS
from tests.scp_recon.support import fly_few, refusal

PICTURES: dict[str, Any] = {
    "number": 6,
    "map_error_m": 0.5,
    "every_s": 1800.0,
    "pixel_error": 0.5,
    "field_of_view_deg": 30.0,
    "pixels": 1024,
}
FEEDBACK: dict[str, Any] = {
    "policy.kind": "feedback",
    "boundary.final_sigma_velocity_m_s": 1.0,
    "grid.step_max_s": 900.0,
    "navigation.landmarks": PICTURES,
}
"""Burns at 0, 8000, 25,000 and 34,842 s, of which all but the first are corrected."""


def mission_with(changes: Mapping[str, Any]) -> Mission:
    mission = Mission.from_scenario(load_scenario().replace(FEEDBACK).replace(changes))
    return mission.along(BURNS)


def pictures_after(mission: Mission, cut_off_s: float) -> tuple[Array, Array, Array]:
    """Derivatives of all pixels until a cut-off and of the state there, by everything uncertain.

    By the initial state, the parameters and the errors of the burns before; then those of the pixels by
    the map. Central differences of nonlinear flights and of a pinhole camera.
    """
    scenario, p = mission.scenario, mission.uncertain.count
    before = np.array(scenario.burn_times_s) < cut_off_s
    times = np.union1d(mission.times_s, [*picture_times_s(scenario, cut_off_s), cut_off_s])
    fine = replace(mission, times_s=times)
    half = np.deg2rad(0.5 * PICTURES["field_of_view_deg"])
    focal = 0.5 * PICTURES["pixels"] / np.tan(half)
    places, states = landmarks_m(scenario), flown(fine, np.zeros(6), np.zeros(p), BURNS)
    shots = []
    for time in picture_times_s(scenario, cut_off_s):
        at = int(np.searchsorted(times, time))
        position, turn = states[at, :3], mission.rotation.body_to_j2000(time)
        radii, sun = np.array(scenario.body.radii_m), mission.sun_direction(time)
        outward = (places / radii**2) @ turn.T
        line = places @ turn.T - position
        off = np.arccos(-line @ position / np.linalg.norm(line, axis=1) / np.linalg.norm(position))
        seen = (outward @ sun > 0.0) & ((outward * line).sum(axis=1) < 0.0) & (off < half)
        z = -position / np.linalg.norm(position)
        x = np.cross(z, [0.3, 0.9, -0.2])
        x /= np.linalg.norm(x)
        shots.append((at, time, np.stack([x, np.cross(z, x), z]), np.flatnonzero(seen)))

    def look(state: Array, draws: Array, burns: Array, map_m: Array) -> tuple[Array, Array]:
        path, pixels = flown(fine, state, draws, burns), []
        turned = mission.deviating(mission.uncertain.deviation(draws)).rotation if p else None
        rotation = turned or mission.rotation
        for at, time, axes, seen in shots:
            landmarks = (places + map_m)[seen] @ rotation.body_to_j2000(time).T
            x, y, z = axes @ (landmarks - path[at, :3]).T
            pixels.append(focal * np.stack([x / z, y / z], axis=1).ravel())
        end = path[np.searchsorted(times, cut_off_s)].copy()
        end[3:] -= burns[np.array(scenario.burn_times_s) == cut_off_s].sum(axis=0)
        return np.concatenate(pixels), end

    none = [np.zeros(6), np.zeros(p), np.zeros(BURNS.shape), np.zeros(places.shape)]
    steps = [np.repeat([1e-2, 1e-6], 3), np.full(p, 1e-3), 1e-6, 1e-3]
    columns: list[list[tuple[Array, Array]]] = []
    for which in range(4):
        columns.append([])
        for k in range(none[which].size):
            size = float(np.broadcast_to(steps[which], none[which].size)[k])
            sides = []
            for sign in (size, -size):
                moved = [one.copy() for one in none]
                moved[which].flat[k] = sign
                state, draws, burns, map_m = moved
                sides.append(look(state, draws, BURNS + burns, map_m))
            (ahead, end), (behind, start) = sides
            columns[which].append(((ahead - behind) / (2 * size), (end - start) / (2 * size)))
    burns = [columns[2][3 * i + j] for i in np.flatnonzero(before) for j in range(3)]
    own = [*columns[0], *columns[1], *burns]
    return (
        np.stack([one for one, _ in own], axis=1),
        np.stack([one for _, one in own], axis=1),
        np.stack([one for one, _ in columns[3]], axis=1),
    )


def flown(fine: Mission, state: Array, draws: Array, burns: Array) -> Array:
    deviating = fine.deviating(fine.uncertain.deviation(draws)) if draws.any() else fine
    unit, speed = fine.units.state, fine.units.speed_m_s
    start = (fine.initial_state + state) / unit
    return np.asarray(deviating.dynamics.rollout(start, burns / speed) * unit)


@pytest.mark.slow
@pytest.mark.parametrize(
    "known", [{}, {"knowledge.body.gm_m3_s2": 0.3, "knowledge.body.pole_ra_deg": 2.0}]
)
def test_filter_knows_as_much_as_batch_least_squares(known):
    """All pictures at once, with the map's errors in the covariance of the pixels' errors."""
    mission = mission_with(known)
    lin = mission.dynamics.linearise(mission.problem, from_burns(mission, BURNS))
    share = mission.scenario.uncertainty.execution_error or 0.0
    for j, cut_off in enumerate(cut_offs_s(mission.scenario).values()):
        pixels, ends, by_map = pictures_after(mission, cut_off)
        burns = BURNS[np.array(mission.scenario.burn_times_s) < cut_off]
        start, count = mission.initial_factor, mission.uncertain.count
        prior = block_diag(start @ start.T, np.eye(count), np.diag((share * burns.ravel()) ** 2))
        errors = PICTURES["pixel_error"] ** 2 * np.eye(len(pixels))
        errors += PICTURES["map_error_m"] ** 2 * by_map @ by_map.T
        weight = prior @ pixels.T @ np.linalg.inv(pixels @ prior @ pixels.T + errors)
        expected = ends @ (prior - weight @ pixels @ prior) @ ends.T
        factor = lin.flown_filter.after(j)[:6] * mission.units.state[:, None]
        sigma = np.sqrt(np.diag(expected))
        apart = (factor @ factor.T - expected) / np.outer(sigma, sigma)
        assert np.abs(apart).max() < 1e-5


SELDOM = {"every_s": 9000.0, "turnaround_s": 3600.0}


@pytest.mark.parametrize(
    ("changes", "expected"),
    [
        ({}, {1: 3600.0, 2: 19_800.0, 3: 30_600.0}),
        ({"navigation.lead_s": 0.0}, {1: 7200.0, 2: 23_400.0, 3: 34_200.0}),
        ({"navigation.contacts": SELDOM}, {1: 0.0, 2: 18_000.0, 3: 27_000.0}),
        ({"navigation.contacts": SELDOM | {"onboard": [3]}}, {1: 0.0, 2: 19_800.0, 3: 27_000.0}),
        ({"navigation.landmarks": PICTURES | {"every_s": 20_000.0}}, {1: 0.0, 2: 20_000.0}),
    ],
)
def test_burns_use_the_pictures_that_reach_them(changes, expected):
    """The last picture by the cut-off or before the contact; on board the last picture in time."""
    assert cut_offs_s(mission_with(changes).scenario) == pytest.approx(expected)


def test_burns_without_new_pictures_are_named():
    mission = mission_with({"navigation.landmarks": PICTURES | {"every_s": 20_000.0}})
    (told,) = [str(w) for w in mission.warnings if w.entry == "navigation.landmarks"]
    assert "burn 4" in told


def test_replans_measure_by_pictures():
    mission = mission_with({"navigation.landmarks": PICTURES | {"every_s": 600.0}})
    found = replans(mission, BURNS)
    sigma = [float(np.sqrt(np.trace(one.measurement_covariance[:3, :3]))) for one in found]
    assert len(sigma) == 3
    assert max(sigma) < 10.0


@pytest.mark.slow
def test_plans_are_made_along_their_own_path(monkeypatch):
    """The plan is verified, and refuted with measurements of a better map."""
    fly_few(monkeypatch)
    pictures = {"policy.kind": "feedback", "navigation.landmarks": PICTURES}
    found = scp_recon.plan(load_scenario().replace(pictures | {"grid.step_max_s": 900.0}))
    solution = make_solution(found)
    assert misjudged(found.mission, solution.corrections, found.burns_m_s) <= SAME
    assert verify(solution.mission, solution).ok
    (one,) = solution.policy.corrections
    better = replace(
        one, measurement_covariance=(0.5 * np.array(one.measurement_covariance)).tolist()
    )
    tampered = replace(solution, policy=replace(solution.policy, corrections=[better]))
    assert "policy.corrections" in verify(tampered.mission, tampered).failed


SIGMAS = {"sigma_position_m": 1.0, "sigma_velocity_m_s": 1e-3}
LATE = {"windows_s": [[40_000.0, 41_000.0]], "turnaround_s": 600.0}
BAD: list[tuple[dict[str, Any], str]] = [
    *(
        ({"navigation.landmarks": PICTURES | {entry: value}}, entry)
        for entry, value in (
            *(("pixels", None), ("map_error_m", -1.0), ("map_error_m", 1e8), ("number", 0)),
            ("field_of_view_deg", 190.0),
        )
    ),
    ({"navigation": {"landmarks": PICTURES, **SIGMAS}}, "in one way"),
    ({"navigation.lead_s": 35_000.0}, "lead_s"),
    ({"navigation.landmarks": PICTURES | {"field_of_view_deg": 0.1}}, "no landmark that is lit"),
    ({"navigation.contacts": LATE}, "navigation.contacts"),
]


@pytest.mark.parametrize(("changes", "words"), BAD)
def test_bad_landmarks_are_refused_in_one_message(changes, words):
    said = str(refusal(lambda: mission_with(changes).problem))
    assert words in said
    assert said.startswith("navigation")
    assert "\n" not in said


@nightly
def test_designs_picture_landmarks_along_their_own_path():
    pictures = {"policy.kind": "feedback", "navigation.landmarks": PICTURES}
    found = scp_recon.design(load_scenario("nightingale").replace(pictures)).plan
    solution = make_solution(found)
    assert misjudged(found.mission, solution.corrections, found.burns_m_s) <= SAME
    assert verify(solution.mission, solution).ok
