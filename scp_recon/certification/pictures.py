"""Plan with pictures of landmarks along the plan's own path, which says what the pictures tell."""

from __future__ import annotations

from collections.abc import Callable

from formulations.arrays import Array
from scp_recon.mission.mission import Mission
from scp_recon.planning.plan import Plan
from scp_recon.results.policy import SAME, misjudged, policy_of
from scp_recon.scp.status import Status

ROUNDS_MAX = 4
"""Times that a plan is made again along the path of the one before."""


def with_pictures(
    mission: Mission, burns_m_s: Array, make: Callable[[Mission, Plan | None], Plan]
) -> Plan:
    """Make a plan, and again along its own path until pictures tell there what it took them to tell.

    `make` plans a mission, from an earlier plan if there is one; the first pictures are along the path
    of burns (m, 3).

    Raises:
        InputError: if no picture shows a landmark before a cut-off.
    """
    found = make(mission.along(burns_m_s), None)
    for _ in range(ROUNDS_MAX):
        policy = policy_of(found.mission, found.final.result.lin)
        if found.status is not Status.CONVERGED or not policy:
            break
        if misjudged(found.mission, policy, found.burns_m_s) <= SAME:
            break
        found = make(found.mission.along(found.burns_m_s), found)
    return found
