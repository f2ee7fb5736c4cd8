"""The one rule by which a solution's times are those of its scenario, for reading and verifying."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from scp_recon.mission.mission import Mission

TIME_ERROR_S = 1e-3
"""Far above how the edges of a window differ from one machine to another."""


def strange_times(
    mission: Mission, burn_times_s: Sequence[float], node_times_s: Sequence[float]
) -> list[str]:
    """Which of a plan's times are not its mission's: of `burns.t_s` and `nodes.t_s`.

    The window's edges are found by a root search, so that nodes agree within `TIME_ERROR_S`. Burns, and
    the nodes they fall on, are at the scenario's own numbers, to the last bit.

    Args:
        mission: of the plan.
        burn_times_s: of its burns, s.
        node_times_s: of its nodes, s.
    """
    firing, nodes = np.array(mission.scenario.burn_times_s), np.array(node_times_s)
    agree = {
        "burns.t_s": np.array_equal(burn_times_s, firing),
        "nodes.t_s": len(nodes) == len(mission.times_s)
        and np.allclose(nodes, mission.times_s, rtol=0.0, atol=TIME_ERROR_S)
        and np.array_equal(nodes[mission.burn_nodes], firing),
    }
    return [name for name, does in agree.items() if not does]
