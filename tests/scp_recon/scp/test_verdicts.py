"""Every plan ends with a verdict: converged, or infeasible and no other method knows better.

The quick form of two studies that are run by hand, 1,000 random scenarios and 288 flights between
phases of a circular orbit: those that once cycled, stalled or failed, and a few others.

At kinks the deciding phase ends where a hull of slopes proves a minimum, and nowhere else. There the
violation is the largest of planes with a known least value, and its curvature. As with flights, a
step's model knows the slope at the iterate alone.
"""

from types import SimpleNamespace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.optimize import linprog

from formulations.program.subproblem import Step
from scp_recon.mission.mission import Mission
from scp_recon.planning import initial_guess
from scp_recon.planning.plan import Plan
from scp_recon.planning.planner import plan
from scp_recon.scenario.load import load_scenario
from scp_recon.scp.loop import Result, Timing, run
from scp_recon.scp.status import Status
from scp_recon.scp.verdict import NEAR, REACH, LeastViolation
from tests.helpers import nightly, usually
from tests.scp_recon.passes.support import home_scenario
from tests.scp_recon.support import mission_of

VERDICTS = (Status.CONVERGED, Status.INFEASIBLE)


def planned(mission: Mission, start: str = "cold", algorithm: str = "scvx") -> Plan:
    guesses = {"cold": initial_guess.cold, "warm": initial_guess.ballistic}
    return plan(mission, guesses[start](mission), algorithm=algorithm)


def random_scenario(seed: int) -> Mission:
    """Another final position, other errors and risk, and cones of 4 to 16 facets."""
    rng = np.random.default_rng([2026, seed])
    final = np.array(load_scenario().boundary.final_position_m) + rng.normal(0.0, 30.0, 3)
    return mission_of(
        'polytopes.ball="tangent"',
        f"polytopes.cone={rng.integers(4, 17)}",
        f"risk.p_chance={rng.uniform(0.6, 0.99):.4f}",
        f"uncertainty.execution_error={rng.uniform(0.02, 0.15):.4f}",
        f"uncertainty.initial_sigma_fraction={rng.uniform(0.003, 0.015):.5f}",
        f"boundary.final_position_m={[round(float(x), 2) for x in final]}",
    )


def between_phases(departure_deg: int, arrival_deg: int, sense: str) -> Mission:
    """On a circle of 1 km in the terminator plane."""
    spans = {"departure_deg": [departure_deg] * 2, "arrival_deg": [arrival_deg] * 2}
    return Mission.from_scenario(home_scenario(**spans, sense=f"{sense}_handed"))


def test_a_vanishing_burn_at_the_cone_converges():
    """Burn 3 is zero at the solution: where it points is the program's to find, not the iterate's."""
    found = planned(mission_of("risk.p_chance=0.8", 'polytopes.ball="tangent"'))
    final = found.final.result
    assert final.status is Status.CONVERGED
    sizes = np.linalg.norm(final.lin.iterate.burns, axis=1) * found.mission.units.speed_m_s
    assert sizes[2] < 1e-6
    assert sizes.sum() == pytest.approx(0.1137064, abs=1e-6)
    assert len(final.records) <= 8


CYCLED = (92, 165, 166, 321, 368, 380, 405, 463)
FALSELY_INFEASIBLE = (
    44,  # by a burn that vanishes
    505,  # at a penalty weight that is not exact
    559,  # with the facets of the first choice
)
BETWEEN_PHASES = (
    (150, 210, "left"),  # stalled: far from any vertex, and the solver's rounding at the end
    (270, 90, "right"),  # from a line through the body's centre no answer of the solver
    (180, 240, "left"),  # these without a solution: the iteration limit, stalled
    (210, 270, "right"),
)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("scenario", "given", "verdicts"),
    [
        *((random_scenario, (seed,), VERDICTS) for seed in usually(CYCLED, 2)),
        *((random_scenario, (seed,), VERDICTS[:1]) for seed in usually(FALSELY_INFEASIBLE, 2)),
        *((between_phases, given, VERDICTS) for given in usually(BETWEEN_PHASES, 1)),
    ],
)
def test_once_undecided_cases_end_with_a_verdict(scenario, given, verdicts):
    assert planned(scenario(*given)).final.result.status in verdicts


@nightly
def test_what_is_called_infeasible_no_other_method_solves():
    scenario = random_scenario(78)
    for start, algorithm in (("cold", "scvx"), ("warm", "ptr")):
        final = planned(scenario, start, algorithm).final.result
        assert final.status is not Status.CONVERGED


N = 3
PROBLEM = SimpleNamespace(controls=lambda burns, gains, times: burns.ravel())  # noqa: ARG005 -- as there


def at(z) -> SimpleNamespace:
    burns = np.reshape(z, (1, -1))
    iterate = SimpleNamespace(burns=burns)
    known = {"problem": PROBLEM, "iterate": iterate, "controls": burns.ravel()}
    return SimpleNamespace(**known, is_dynamically_feasible=True)


class Planes:
    """Merit and subproblem at once; `reach` is None for the slope at the iterate alone."""

    rows, problem = (
        SimpleNamespace(with_factor=False),
        SimpleNamespace(n_burns=1, dv_max=1.0, feedback=None),
    )

    def __init__(self, slopes, values, bend, bundle, reach=None) -> None:
        self.slopes, self.values, self.bend = slopes, values, bend
        self.bundle, self.reach, self.merit = bundle, reach, self

    def __call__(self, lin, *_) -> float:
        z = lin.controls
        heights = self.values + self.slopes @ z
        slope = self.slopes[heights.argmax()] + self.bend * z
        if not any(np.array_equal(z, one) for one, _ in self.bundle):
            self.bundle.insert(0, (z, slope))
        return float(heights.max() + 0.5 * self.bend * (z @ z))

    def violations(self, lin):
        return {"dynamics": np.zeros(1), "planes": np.array([self(lin)])}

    def cost(self, _) -> float:
        return 0.0

    def worst_violation(self, lin) -> float:
        return self(lin)

    def update(self, lin) -> None:
        self.value, z, self.centre = self(lin), lin.controls, lin.controls
        near = [(np.abs(one - z).max(), slope) for one, slope in self.bundle[:12]]
        own = next(slope for one, slope in self.bundle if np.array_equal(one, z))
        self.near = [own, *(s for far, s in near if self.reach and 0.0 < far <= self.reach)]

    def solve(self, radius, _) -> Step:
        cost, limits = np.r_[np.zeros(N), 1.0], [(-radius, radius)] * N + [(0.0, None)]
        rows = np.column_stack([self.near, -np.ones(len(self.near))])
        found = linprog(cost, A_ub=rows, b_ub=np.full(len(rows), -self.value), bounds=limits)
        return Step((self.centre + found.x[:N])[None], found.fun, 0.0, 0.0)


DYNAMICS = SimpleNamespace(
    close_defects=lambda lin, burns, gains, times, misses: at(burns),  # noqa: ARG005 -- as there
    linearise=lambda problem, iterate: at(iterate.burns),  # noqa: ARG005 -- as there
)


def decided(seed: int, *, hull: bool) -> tuple[Result, float, float]:
    """The phase's result, the least violation of planes with 0 in their hull, and the largest slope."""
    rng = np.random.default_rng(seed)
    slopes = rng.normal(size=(N + 1, N))
    slopes -= rng.dirichlet(np.ones(N + 1)) @ slopes
    least, bundle = 10.0 ** rng.uniform(-4.0, -2.0), []
    planes = Planes(slopes, np.full(N + 1, least), rng.uniform(0.0, 2.0), bundle)
    near = Planes(slopes, planes.values, planes.bend, bundle, REACH) if hull else None
    phase = LeastViolation(feasible=1e-5, stationary=1e-7, max_iterations=300, slopes=near)
    start = at(rng.uniform(-NEAR, NEAR, N))
    before = Result(Status.STALLED, start, (), Timing())
    found = run(planes, DYNAMICS, start, phase, lambda _: None, before)
    return found, least, np.abs(slopes).sum(axis=1).max() + N * planes.bend * NEAR


@given(st.integers(0, 2**32 - 1))
def test_a_kinks_minimum_is_found_and_proved(seed):
    found, least, steepest = decided(seed, hull=True)
    last = found.records[-1]
    assert found.status is Status.INFEASIBLE
    promised = last.predicted * NEAR / last.trust_radius
    assert promised <= LeastViolation.LITTLE * last.merit
    # A slope of another point bounds the violation there, and the two differ by twice their reach.
    assert least <= last.merit <= least + promised + 2.0 * REACH * steepest


def test_one_slope_at_a_kink_proves_nothing():
    status = [decided(seed, hull=False)[0].status for seed in range(20)]
    assert Status.STALLED in status
    assert all(one in (Status.STALLED, Status.INFEASIBLE) for one in status)
