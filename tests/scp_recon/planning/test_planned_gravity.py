"""Plans with harmonics that turn with the body: verified, flown, and IPOPT's arcs alike."""

import casadi as ca
import numpy as np
import pytest

from scp_recon.errors import InputError
from scp_recon.monte_carlo.sampling import fly_block
from scp_recon.physics.flow import propagate
from scp_recon.physics.forces import accelerations
from scp_recon.planning.initial_guess import ballistic
from scp_recon.planning.ipopt import casadi_arcs
from scp_recon.planning.planner import plan
from scp_recon.reports.tables import probabilities_table
from scp_recon.results.solution import make_solution
from scp_recon.verification.reintegration import verify
from tests.scenarios import COARSE
from tests.scp_recon.bodies.test_kernels import GFC
from tests.scp_recon.support import COMPANION, fly_few, mission_of

DEGREE = "body.planned_degree"


def test_a_plan_with_harmonics_is_verified(monkeypatch):
    fly_few(monkeypatch)
    mission = mission_of(f"{DEGREE}=3")
    checked = verify(mission, make_solution(plan(mission, ballistic(mission))))
    assert checked.ok, checked.failed
    assert "flown with harmonics to degree 3" in probabilities_table(mission, checked).note


def test_all_of_the_field_is_flown_as_the_truth_is(default_plan):
    j2, turning = default_plan.mission, mission_of(f"{DEGREE}=8")
    planner, truth, before = (
        fly_block(each, default_plan.burns_m_s, each.times_s, 0, flights=3, truth=field).states[-1]
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
def test_a_degree_that_the_field_does_not_have_is_refused(overrides, given, tmp_path):
    field = tmp_path / "field.gfc"
    field.write_text(GFC, "utf-8")
    with pytest.raises(InputError) as refused:
        mission_of(*(each.format(field=field) for each in overrides))
    assert (refused.value.entry, refused.value.given) == (DEGREE, given)


def test_forces_that_turn_need_a_time():
    turning = mission_of(f"{DEGREE}=2")
    state = turning.initial_state
    with pytest.raises(ValueError, match="times at which arcs start"):
        propagate(state, 1.0, turning.forces)
    with pytest.raises(ValueError, match="surroundings"):
        accelerations(state[:3, None], turning.forces)
