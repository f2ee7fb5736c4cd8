"""Near the border of feasibility every plan ends converged or infeasible, rightly.

A limit is bisected, and probed within a ten-thousandth of the border. Multipliers grow without bound
there, and the set of feasible plans shrinks to a point.
"""

import itertools

import numpy as np
import pytest

from scp_recon.planning import initial_guess
from scp_recon.planning.plan import Plan
from scp_recon.planning.planner import plan
from scp_recon.results.solution import make_solution
from scp_recon.scp.status import Status
from scp_recon.verification.reintegration import verify
from tests.helpers import nightly
from tests.scp_recon.support import mission_of

pytestmark = pytest.mark.slow

RISKS = {
    "uniform": (),
    "node": ('risk.allocation="exact"', 'risk.scope="node"'),
    "flight": ('risk.allocation="exact"', 'risk.scope="flight"'),
}
LIMITS = {
    "burns.dv_max_m_s": (0.042, 0.036),
    "risk.p_chance": (0.7, 0.999999),
    "observation.site_distance_max_m": (740.0, 505.0),
    "observation.site_distance_min_m": (500.0, 735.0),
    "observation.emission_max_deg": (45.0, 20.5),
    "uncertainty.execution_error": (0.1, 0.5),
}
"""Values with a plan, and without one."""

WITHIN, APART = 1e-4, 3e-6
"""Relative distance of probes from the border, and to which it is bisected."""


BY_CHANCE = 0.005
"""Standard deviation of a probability of 10,000 flights."""


def probe(risk: str, entry: str, value: float) -> Plan:
    mission = mission_of(*RISKS[risk], f"{entry}={value!r}")
    return plan(mission, initial_guess.cold(mission))


def sweep(risk: str, entry: str, probes: int) -> list[Plan]:
    """Plans from the feasible end to the infeasible one."""
    good, bad = LIMITS[entry]
    found = {}
    while abs(good - bad) > APART * abs(good):
        middle = 0.5 * (good + bad)
        found[middle] = probe(risk, entry, middle)
        good, bad = (middle, bad) if found[middle].status is Status.CONVERGED else (good, middle)
    border = 0.5 * (good + bad)
    for share in np.linspace(-WITHIN, WITHIN, max(2, probes - len(found))):
        value = float(border * (1.0 + share))
        found[value] = probe(risk, entry, value)
    return [found[value] for value in sorted(found, reverse=bool(LIMITS[entry][0] > bad))]


def assert_right(one: Plan) -> None:
    lin = one.final.result.lin
    if one.status is Status.CONVERGED:
        found = verify(one.mission, make_solution(one))
        assert [check for check in found.failed if not check.startswith("P(")] == []
        # A plan has just the probability required here: flights refute one in forty by chance.
        required = one.mission.scenario.risk.p_chance
        assert all(part.high > required - BY_CHANCE for part in found.probabilities)
    else:
        assert one.status is Status.INFEASIBLE
        assert one.final.merit.worst_violation(lin) > one.final.tolerance


@nightly
@pytest.mark.parametrize("risk", RISKS)
@pytest.mark.parametrize("entry", LIMITS)
def test_a_limits_border_switches_the_status_once(risk, entry):
    plans = sweep(risk, entry, probes=40)
    for one in plans:
        assert_right(one)
    assert sum(a.status is not b.status for a, b in itertools.pairwise(plans)) == 1


EMISSION, ERROR = "observation.emission_max_deg", "uncertainty.execution_error"
STALLED = [
    ("uniform", "burns.dv_max_m_s", 0.0409084, Status.INFEASIBLE),
    ("uniform", "burns.dv_max_m_s", 0.04091012, Status.CONVERGED),
    ("node", "risk.p_chance", 0.9996328567697995, Status.INFEASIBLE),
]
STALLED_BY_NIGHT = [
    ("node", "burns.dv_max_m_s", 0.0370792, Status.INFEASIBLE),
    ("flight", "burns.dv_max_m_s", 0.037169094085693355, Status.INFEASIBLE),
    # Of which few directions alone say that they are infeasible.
    ("flight", EMISSION, 29.84750366, Status.CONVERGED),
    # Where a conic solver's miss of the final state, weighed, refused every step.
    ("flight", EMISSION, 29.849, Status.CONVERGED),
    # Where kinks of the estimate refused steps: the first far from the border, the second at it.
    ("flight", ERROR, 0.23, Status.INFEASIBLE),
    ("flight", ERROR, 0.22958984375, Status.INFEASIBLE),
    # Which the iterations of another algorithm, of a lower cost, hid.
    ("flight", EMISSION, 29.75, Status.INFEASIBLE),
]


@pytest.mark.parametrize(
    ("risk", "entry", "value", "status"),
    [*STALLED, *(pytest.param(*one, marks=nightly) for one in STALLED_BY_NIGHT)],
)
def test_probes_that_once_stalled_have_a_verdict(risk, entry, value, status):
    one = probe(risk, entry, value)
    assert one.status is status
    assert_right(one)
