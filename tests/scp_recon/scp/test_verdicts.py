"""Every plan ends with a verdict: converged, or infeasible and no other method knows better.

The quick form of two studies that are run by hand, 1,000 random scenarios and 288 flights between
phases of a circular orbit: those that once cycled, stalled or failed, and a few others.
"""

import numpy as np
import pytest

from scp_recon.mission.mission import Mission
from scp_recon.planning import initial_guess
from scp_recon.planning.plan import Plan
from scp_recon.planning.planner import plan
from scp_recon.scenario.load import load_scenario
from scp_recon.scp.status import Status
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
