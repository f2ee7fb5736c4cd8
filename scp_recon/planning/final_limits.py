"""Who can keep limits on the covariance after the last burn."""

from __future__ import annotations

from scp_recon.errors import InputError
from scp_recon.mission.mission import Mission


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
