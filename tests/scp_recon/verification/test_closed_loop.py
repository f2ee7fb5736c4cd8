"""Plans with feedback: the verification flies their corrections anew, and finds what was changed."""

import io
import json
import re
from dataclasses import replace
from functools import partial

import numpy as np
import pytest
from rich.console import Console
from scipy.special import ndtr

from formulations.arrays import Array
from formulations.problem.flyby import Iterate
from formulations.problem.regions import Ball, Cone
from formulations.program.subproblem import MeritFunction
from formulations.rows.node_probability import Event, node_quantiles
from formulations.rows.uniform import DeterministicRows
from scp_recon.cli.command import WIDE
from scp_recon.cli.plan_view import show_plan
from scp_recon.errors import InputError
from scp_recon.interop.export import Export, heading
from scp_recon.mission.mission import Mission
from scp_recon.physics.geometry import angle
from scp_recon.planning import initial_guess
from scp_recon.planning.plan import Plan, Provenance, Stage, StageSpec
from scp_recon.planning.planner import plan
from scp_recon.results.comparison import compare
from scp_recon.results.read import read_solution
from scp_recon.results.solution import FILE_NAME, HASH, Solution, make_solution
from scp_recon.results.verification import Verification
from scp_recon.scp.algorithms import SCvx
from scp_recon.scp.loop import Result, Timing
from scp_recon.scp.status import Status
from scp_recon.verification.consistency import inconsistencies
from scp_recon.verification.reintegration import limits_of, not_executed, verify
from tests.helpers import usually
from tests.scenarios import COARSE
from tests.scp_recon.support import fly_few, mission_of
from tests.scp_recon.verification.test_verification import changed, moved

pytestmark = pytest.mark.slow

MEASURED = (
    COARSE,
    "boundary.final_sigma_position_m=5000",  # which the burn after the window is corrected for
    'policy.kind="feedback"',
    "navigation.sigma_position_m=10",
    "navigation.sigma_velocity_m_s=0.0005",
)
EXPECTED = 'policy.cost="expected"'
"""A plan for the mean takes few iterations."""
BURNS_M_S = np.array(
    [
        [-0.0084, 0.0505, 0.0130],
        [-0.0073, 0.0162, -0.0047],
        [-0.0002, 0.0002, -0.0001],
        [-0.0124, 0.0368, -0.0065],
    ]
)
CROSSED = (*MEASURED, "navigation.lead_s=3600")
LAST_TOO = "boundary.final_sigma_velocity_m_s=0.5"
"""So that the last burn is corrected."""


@pytest.fixture(scope="module")
def solution() -> Solution:
    mission = mission_of(*MEASURED, EXPECTED, "navigation.lead_s=3600")
    return make_solution(plan(mission, initial_guess.cold(mission)))


@pytest.fixture(scope="module")
def crossed() -> Solution:
    return with_gains("navigation.lead_s=3600")


@pytest.fixture(scope="module")
def verification(solution) -> Verification:
    return checked(solution)


def checked(solution: Solution, mission: Mission | None = None) -> Verification:
    with pytest.MonkeyPatch.context() as patch:
        fly_few(patch)
        return verify(mission or solution.mission, solution)


def test_description_of_plan_names_its_corrections(crossed):
    """In the heading of every file for other tools, and beside other plans."""
    policy, export = crossed.policy, Export.of(crossed)
    assert policy is not None
    told = " ".join(heading(export))
    numbers = [one.burn for one in policy.corrections]
    assert [int(burn) for burn in re.findall(r"burn (\d) is corrected in flight", told)] == numbers
    assert f"99 % {1e3 * policy.dv99_m_s:.3f} mm/s; burns are without corrections" in told
    none = [replace(burn, dv_m_s=(0.0, 0.0, 0.0)) for burn in crossed.burns]
    without = replace(export, solution=replace(crossed, burns=none))
    told = " ".join(heading(without))
    assert [int(burn) for burn in re.findall(r"burn (\d): none, but its", told)] == numbers
    beside = compare(["one", "two"], [crossed, replace(crossed, policy=None)])
    assert beside["commanded delta-v, 99 %"] == (policy.dv99_m_s, crossed.total_dv_m_s)


def some_gains(mission: Mission) -> Array:
    """On innovations, nondimensional."""
    return np.random.default_rng(1).normal(scale=5e-3, size=mission.feedback.size)


def with_gains(*overrides: str) -> Solution:
    """Given burns, and gains that nobody would choose: every estimate so far matters to every burn."""
    mission = mission_of(*MEASURED, *overrides)
    guess = initial_guess.from_burns(mission, BURNS_M_S)
    at = Iterate(guess.burns, guess.mean, some_gains(mission))
    lin = mission.dynamics.linearise(mission.problem, at).informed
    merit = MeritFunction(mission.problem, DeterministicRows(mission.problem))
    result = Result(Status.MAX_ITERATIONS, lin, (), Timing())
    stage = Stage(StageSpec("P3", merit.rows), result, merit, SCvx().feasible)
    made = Provenance("none", "none", "none", "given", "none")
    return make_solution(Plan(mission, made, 0.0, stages=(stage,), final=stage, timing=Timing()))


def gates(magnitude: float, bias: float) -> str:
    return (
        "uncertainty.gates={magnitude_fixed_m_s=0.002, pointing_fixed_m_s=0.0005, "
        f"magnitude_proportional={magnitude}, pointing_proportional_rad=0.02, magnitude_bias={bias}}}"
    )


# --- a right policy -----------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("overrides", "burns"),
    usually(
        [
            (("navigation.lead_s=0",), [2, 3]),
            # The state is measured twice before burn 2 is done, which no estimate may know of.
            (("navigation.lead_s=20000", LAST_TOO), [3, 4]),
            (("navigation.lead_s=3600", "navigation.sigma_velocity_m_s=1e4"), [2, 3]),
            (("navigation.lead_s=3600", gates(0.03, 0.0)), [2, 3]),
            (("navigation.lead_s=3600", "navigation.sigma_position_m=1e9", LAST_TOO), [2, 3, 4]),
            (("navigation.lead_s=3600", LAST_TOO), [2, 3, 4]),
            (("navigation.lead_s=3600", gates(0.01, 0.0)), [2, 3]),
            (("navigation.lead_s=20000", gates(0.03, 0.08)), [3]),
        ],
        4,
    ),
    ids=usually(["none", "long", "velocities", "along", "positions", "hour", "across", "bias"], 4),
)
def test_closed_loop_depends_on_corrections_alone(overrides, burns):
    given = with_gains(*overrides)
    v = checked(given)
    limits = limits_of(given.mission)
    assert [correction.burn for correction in given.policy.corrections] == burns
    assert v.covariance_error <= limits["covariance_error"]
    assert v.knowledge_error is not None
    assert v.knowledge_error <= limits["knowledge_error"]
    assert not {name for name in v.failed if name.startswith("policy")}


def test_a_plan_with_feedback_is_confirmed(verification):
    assert verification.ok, verification.failed
    assert [(b.burn, b.name) for b in verification.burn_limits] == [
        (burn, name) for burn in (2, 3) for name in ("dv_max", "dv_battery")
    ]


# --- limits on corrected burns ------------------------------------------------------------------


def test_limits_on_corrected_burns_match_normal_commands(crossed):
    """Against the integrals along contours that the planner has for balls and cones."""
    speed, burn = crossed.units.speed_m_s, crossed.burns_m_s[1:2]
    factor = some_gains(crossed.mission)[:18].reshape(1, 3, 6)
    sun = crossed.mission.sun_direction(np.array([8000.0]))
    off = np.rad2deg(angle(burn, sun))
    off = float(np.minimum(off, 180.0 - off)[0]) - 2.0
    stricter = mission_of(*CROSSED, "burns.dv_max_m_s=0.019", f"battery.delta_v_cone_deg={off}")
    v = checked(crossed, stricter)
    apex, half, none = np.zeros((1, 3)), np.array([0]), ()
    cones = [Cone(apex, way * sun, float(np.deg2rad(off))) for way in (1.0, -1.0)]
    limits = {
        "dv_max": [Event("size", half, (Ball(apex, 0.019 / speed),), none)],
        "dv_battery": [Event("cone", half, none, (cone,)) for cone in cones],
    }
    for name, events in limits.items():
        quantiles = [node_quantiles(event, burn / speed, factor).value[0] for event in events]
        broken = float(ndtr(-np.array(quantiles)).sum())
        (found,) = (b for b in v.burn_limits if (b.burn, b.name) == (2, name))
        assert 0.01 < broken < 0.5
        assert found.probability == pytest.approx(1.0 - broken, abs=1e-3)
        assert (str(found) in v.failed) == (found.probability < 0.7)


# --- a policy that was changed ------------------------------------------------------------------

FIRST, SECOND = ("policy", "corrections", 0), ("policy", "corrections", 1)
scaled = partial(moved, times=1.01)


@pytest.mark.parametrize(
    ("changes", "named"),
    usually(
        [
            ([scaled(*SECOND, "gain", 0, 1, 3)], ["covariance_error"]),
            ([scaled(*FIRST, "estimate_covariance", 2, 2)], ["knowledge_error"]),
            (
                [
                    *(scaled("policy", figure) for figure in ("mean_m_s", "dv99_m_s")),
                    scaled(*FIRST, "sigma_m_s"),
                ],
                ["policy.corrections", "policy.mean_m_s", "policy.dv99_m_s"],
            ),
            ([scaled(*FIRST, "gain", 0, 1, 3)], ["covariance_error"]),
            ([scaled(*SECOND, "predicted_covariance", 4, 4)], ["knowledge_error"]),
            ([scaled("nodes", "knowledge", 30, 0, 0)], ["knowledge_error"]),
        ],
        3,
    ),
)
def test_what_was_changed_is_named(crossed, changes, named):
    assert set(named) <= set(checked(changed(crossed, *changes)).failed)


@pytest.mark.parametrize(
    "change",
    [
        scaled(*FIRST, "measurement_covariance", 0, 0),
        scaled(*FIRST, "cut_off_s"),
        lambda data: data["policy"]["corrections"].pop(),
    ],
)
def test_a_policy_of_another_scenario_is_named(crossed, change):
    assert "policy.corrections" not in inconsistencies(crossed.mission, crossed)
    assert "policy.corrections" in inconsistencies(crossed.mission, changed(crossed, change))


def test_a_plan_that_lost_its_policy_is_named(solution):
    failed = checked(replace(solution, policy=None)).failed
    assert {"policy.corrections", "covariance_error"} <= set(failed)


def test_policy_round_trips_and_gains_change_the_hash(solution, verification, tmp_path):
    written = solution.with_verification(verification)
    written.write(tmp_path)
    read = read_solution(tmp_path)
    assert read == written
    for ours, theirs in zip(read.corrections, solution.corrections, strict=True):
        np.testing.assert_array_equal(ours.gains, theirs.gains)
    data = json.loads(written.text())
    scaled(*FIRST, "gain", 0, 0, 0)(data)
    (tmp_path / FILE_NAME).write_text(json.dumps(data))
    doubted = read_solution(tmp_path)
    assert HASH in doubted.verification.failed
    scaled(*FIRST, "cut_off_s")(data)
    (tmp_path / FILE_NAME).write_text(json.dumps(data))
    with pytest.raises(InputError, match=r"policy\.corrections"):
        read_solution(tmp_path)


@pytest.mark.parametrize(
    ("change", "told"),
    [
        (lambda p: p["corrections"].reverse(), "ascending burns"),
        (lambda p: p["corrections"][0]["gain"].append(p["corrections"][0]["gain"][0]), "one block"),
        (lambda p: p["corrections"][0]["gain"][0].pop(), "3 by 6"),
        (lambda p: p["corrections"][0]["estimate_covariance"].pop(), "6 by 6"),
        (lambda p: p["corrections"][1].update(burn=9), "burns that are planned"),
    ],
)
def test_a_policy_of_another_shape_is_refused(solution, change, told):
    with pytest.raises(InputError, match=told):
        changed(solution, lambda data: change(data["policy"]))


def test_the_terminal_tells_the_policy(solution, verification):
    shown = io.StringIO()
    console = Console(file=shown, width=WIDE)
    show_plan(console, solution.mission, solution.with_verification(verification))
    text = shown.getvalue()
    assert f"99 % {1e3 * solution.policy.dv99_m_s:.3f} mm/s" in text
    assert "correction, 1 sigma" in text
    assert "dv_battery" in text.partition("probability")[2]
    (row,) = (line.split() for line in text.splitlines() if line.split()[:2] == ["2", "4400"])
    assert float(row[3]) == pytest.approx(1e3 * solution.policy.corrections[0].sigma_m_s, abs=1e-3)


def test_corrected_burns_are_executed_by_commanded_size(solution):
    """A planned burn may be smaller than the least that is executed, where its corrections are not."""
    planned = np.linalg.norm(solution.burns_m_s, axis=1)
    (one, *_), (stored, *_) = solution.corrections, solution.policy.corrections
    commanded = np.hypot(planned[one.burn], stored.sigma_m_s)

    def named(least: float) -> bool:
        mission = solution.mission.changed({"burns.dv_min_m_s": least})
        other = replace(solution, scenario=mission.scenario)
        return f"dv_min of burn {1 + one.burn}" in not_executed(mission, other)

    assert named(1.01 * commanded)
    assert not named(0.5 * (planned[one.burn] + commanded))
