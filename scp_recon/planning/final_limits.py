"""Who can keep limits on the covariance after the last burn, and what a violation is charged first."""

from __future__ import annotations

from scp_recon.errors import InputError
from scp_recon.mission.mission import Mission

WEIGHT = 100.0
"""First penalty weight beside such a limit. Its multiplier may exceed the usual ten; and at a thousand,
which comes next, what the probability of whole flights cannot resolve would hide what there is to gain.
"""


def has_final_limit(mission: Mission) -> bool:
    """Whether a mission limits the covariance after the last burn."""
    return any(limit is not None for limit in mission.problem.final_spread)


def require_no_final_limit(mission: Mission, needs: str) -> None:
    """Refuse what has no rows for limits on the final covariance.

    Raises:
        InputError: if the mission has one.
    """
    limits = {
        name: getattr(mission.scenario.boundary, name)
        for name in ("final_sigma_position_m", "final_sigma_velocity_m_s")
    }
    for name, limit in limits.items():
        if limit is not None:
            raise InputError(f"boundary.{name}", f"{limit:g}", f"goes with {needs}")
