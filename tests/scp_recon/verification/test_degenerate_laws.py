"""Laws without errors, with hardly any, or along one line go one way from planning to verification."""

from functools import partial
from itertools import cycle

import numpy as np
import pytest

from scp_recon.certification.certify import certify
from scp_recon.mission.mission import Mission
from scp_recon.monte_carlo.limits import MEAN_TOLERANCE, kept_limits, limit_margins
from scp_recon.monte_carlo.sampling import Flyer
from scp_recon.planning import initial_guess
from scp_recon.planning.plan import Plan
from scp_recon.planning.planner import plan
from scp_recon.results.solution import make_solution
from scp_recon.verification.reintegration import verify
from tests.helpers import usually
from tests.scenarios import COARSE
from tests.scp_recon.support import mission_of

EXACT = 'risk.allocation="exact"'
LINE = np.diag([100.0, *[0.0] * 5]).tolist()
"""An initial covariance along one axis."""


def errors(initial: float, execution: float = 0.0) -> tuple[str, str]:
    return (
        f"uncertainty.initial_sigma_fraction={initial}",
        f"uncertainty.execution_error={execution}",
    )


LAWS = {
    "none": errors(0.0),
    "hardly any": errors(1e-6),
    "micrometres": errors(1e-9),
    "just seen": errors(1e-4, 1e-3),
    "burns alone": errors(0.0, 1e-3),
    "a line": (
        f"uncertainty.initial_covariance={LINE}",
        'uncertainty.initial_frame="rtn"',
        "uncertainty.execution_error=0.0",
    ),
    "several limits": (*errors(1e-6), "observation.emission_max_deg=34"),
}
"""Entries by a word for their law."""

CASES = [*zip(LAWS, cycle(["flight", "node"])), *zip(LAWS, cycle(["node", "flight"]))]
"""Every law with risk of both scopes."""


@pytest.mark.slow
@pytest.mark.usefixtures("fewer", "few_flights")
@pytest.mark.parametrize(("law", "scope"), usually(CASES, 2))
def test_degenerate_laws_are_certified_and_verified(law, scope):
    mission = mission_of(EXACT, f'risk.scope="{scope}"', *LAWS[law])

    def planned(at: Mission, start: Plan, target: float) -> Plan:
        return plan(at, start, target=target)

    found = certify(mission, initial_guess.cold(mission), planned)
    assert found.certificate.certifies(0.7)
    checked = verify(found.mission, make_solution(found))
    assert checked.failed == []
    assert all(p.estimate >= 0.7 for p in checked.probabilities)


@pytest.mark.parametrize(
    ("entries", "certain"), [(errors(0.0), True), (errors(1e-5), True), (errors(1e-3), False)]
)
def test_flights_are_certain_within_the_mean_tolerance(entries, certain):
    mission = mission_of(COARSE, *entries)
    burns = np.full((4, 3), 0.02)
    assert Flyer(mission, burns).certain is certain
    assert not Flyer(mission_of(COARSE), burns).certain


@pytest.mark.parametrize(("name", "unit"), [("emission", "rad"), ("safety_radius", "m")])
def test_only_certain_flights_have_the_mean_tolerance(name, unit):
    mission = mission_of(COARSE)
    times = mission.times_s[mission.window_nodes]
    position = np.random.default_rng(1).normal(0.0, 600.0, (len(times), 400, 3))
    margins = partial(limit_margins, mission, times, position, slice(None))
    _, exact = margins()[name]
    _, shifted = kept_limits(margins(certain=True))[name]
    assert np.array_equal(shifted, exact >= -MEAN_TOLERANCE[unit])
    assert np.array_equal(kept_limits(margins())[name][1], exact >= 0.0)
    assert (shifted != (exact >= 0.0)).any()
