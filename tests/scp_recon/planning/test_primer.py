"""The primer's history of plans: against plans with a small burn added, and against Lawden's primer."""

from dataclasses import dataclass, replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.integrate import solve_bvp

from formulations.arrays import Array
from formulations.linearisation.dynamics import Dynamics
from formulations.rows.uniform import DeterministicRows
from scp_recon.mission.mission import Mission
from scp_recon.physics.flow import FlowDerivatives, GridFlow
from scp_recon.planning import initial_guess
from scp_recon.planning.plan import Plan, StageSpec
from scp_recon.planning.planner import Planner
from scp_recon.planning.primer import allowed_part, primer_history, primer_of
from scp_recon.results.solution import make_solution
from scp_recon.scp.loop import run
from scp_recon.scp.status import Status
from tests.helpers import random_unit
from tests.scenarios import COARSE
from tests.scp_recon.support import from_cold, mission_of


@pytest.fixture(scope="module")
def planner() -> Planner[Mission]:
    return Planner(mission_of(COARSE, "polytopes.ball='tangent'", "polytopes.cone=12"))


@pytest.fixture(scope="module")
def plan(planner) -> Plan:
    return planner.plan(initial_guess.cold(planner.task))


@dataclass(frozen=True, eq=False, kw_only=True)
class Kicked(GridFlow):
    """A flow in which the flight is pushed at the end of one arc, whatever the burns."""

    arc: int
    kick: Array

    def differentiate(self, state: Array) -> FlowDerivatives:
        found = super().differentiate(state)
        found.state[self.arc, 3:] += self.kick
        return found


def least_dv(planner: Planner[Mission], plan: Plan, node: int, kick: Array) -> float:
    """Least delta-v of the burns with the plan's own constraints, where a kick is given away."""
    mission = planner.task
    kicked = Dynamics(Kicked(**vars(mission.flow), arc=node - 1, kick=kick), mission.burn_nodes)
    lin = plan.final.result.lin
    start = kicked.close_defects(kicked.linearise(lin.problem, lin.iterate), lin.iterate.burns)
    subproblem = planner.subproblem(plan.final.merit.rows)
    found = run(subproblem, kicked, start, planner.algorithm, lambda _: None)
    assert found.status is Status.CONVERGED
    return found.lin.iterate.total_dv


@pytest.mark.slow
@pytest.mark.parametrize("time_s", [5000.0, 14_900.0, 27_000.0])
def test_an_added_burn_saves_the_primers_amount(planner, plan, time_s):
    history = primer_of(plan)
    assert history.residual < 1e-3
    node = int(np.argmin(np.abs(np.array(history.t_s) - time_s)))
    size, p = 1e-3, np.array(history.vector[node])
    for u in (p / np.linalg.norm(p), random_unit(np.random.default_rng(3), 1)[0]):
        ahead, behind = (least_dv(planner, plan, node, side * size * u) for side in (1, -1))
        assert (behind - ahead) / (2.0 * size) == pytest.approx(p @ u, abs=2e-3)


def test_without_uncertainty_and_constraints_it_is_lawden_s():
    """Two impulses about a point mass: p'' = G(r) p between the burns' directions."""
    mission = mission_of(
        COARSE, "burns.times_s=[0,34842]", "body.j2=0", "spacecraft.srp_area_m2=1e-9"
    )
    problem = replace(mission.problem, constraints=(), dv_cone=0.0, dv_max=1e3)
    mission.__dict__["problem"] = problem
    planner = Planner(mission)
    rows = DeterministicRows(problem)
    start = mission.dynamics.linearise(problem, initial_guess.cold(mission))
    stage = planner.solve(StageSpec("P3", rows), start, mission.dynamics, lambda *_: None)
    history = primer_history(mission, stage)
    burns = stage.result.lin.iterate.burns
    first, last = burns / np.linalg.norm(burns, axis=1)[:, None]
    nodes = np.array(history.t_s) / mission.units.time_s
    track = stage.result.lin.iterate.mean

    def rate(_: Array, y: Array) -> Array:
        r, p = y[:3], y[6:9]
        size = np.linalg.norm(r, axis=0)
        along = np.sum(r * p, axis=0)
        return np.vstack([y[3:6], -r / size**3, y[9:], 3.0 * along * r / size**5 - p / size**3])

    def ends(y: Array, z: Array) -> Array:
        return np.r_[y[:6] - track[0], y[6:9] - first, z[6:9] - last]

    begin = np.vstack([track.T, np.outer(first, np.ones(len(nodes))), np.zeros((3, len(nodes)))])
    lawden = solve_bvp(rate, ends, nodes, begin, tol=1e-8, max_nodes=20_000)
    assert lawden.success
    np.testing.assert_allclose(history.vector, lawden.sol(nodes)[6:9].T, atol=2e-4)
    assert any(history.legal)


@given(st.integers(0, 2**32 - 1), st.floats(0.0, 1.2))
def test_allowed_part_is_largest_off_the_cones(seed, half_angle):
    rng = np.random.default_rng(seed)
    p, sun = rng.normal(size=(5, 3)), random_unit(rng, 5)
    found = allowed_part(p, sun, half_angle)
    assert np.all(found <= np.linalg.norm(p, axis=1) + 1e-12)
    across = np.cross(sun, np.cross(p, sun))
    across /= np.linalg.norm(across, axis=1)[:, None]
    angles = np.linspace(half_angle, np.pi - half_angle, 2001)[:, None, None]
    u = np.cos(angles) * sun + np.sin(angles) * across
    np.testing.assert_allclose(found, np.max(np.sum(u * p, axis=2), axis=0), rtol=1e-6)
    some = random_unit(rng, 200, 5)
    off = np.abs(np.sum(some * sun, axis=2)) <= np.cos(half_angle)
    assert np.all(np.where(off, np.sum(some * p, axis=2), -np.inf) <= found + 1e-12)


def test_errors_that_do_not_shrink_have_no_primer():
    mission = mission_of(
        COARSE,
        *("uncertainty.gates.magnitude_fixed_m_s=1e-5", "uncertainty.gates.pointing_fixed_m_s=0"),
        "uncertainty.gates.magnitude_proportional=0.01",
        "uncertainty.gates.pointing_proportional_rad=0.01",
    )
    found = from_cold(mission)
    assert found.status is Status.CONVERGED
    assert primer_of(found) is None
    assert make_solution(found).primer is None
