"""A plan of an hour with every mode."""

import numpy as np

from scp_recon.mission.mission import Mission
from scp_recon.results.facts import Burn, Nodes, PlanTiming
from scp_recon.results.solution import Solution

SHORT = (
    "burns.times_s=[0.0, 3270.0]",
    "observation.window_s=[1410.0, 1560.0]",
    "schedule={attitude_s=650.0, heating_s=300.0, recharge_s=100.0}",
)


def short_plan(mission: Mission) -> Solution:
    """Two burns that lead nowhere in particular, and the mean that follows from them."""
    burns = np.array([[-0.01, 0.04, 0.02], [0.02, 0.01, -0.02]])
    state, speed = mission.units.state, mission.units.speed_m_s
    mean = mission.dynamics.rollout(mission.initial_state / state, burns / speed) * state
    spread = np.diag([10.0, 10.0, 10.0, 1e-3, 1e-3, 1e-3]) ** 2
    nothing = dict.fromkeys(("setup", "linearise", "canonicalise", "conic_solver", "other"), 0.0)
    return Solution(
        status="converged",
        message="",
        problem="P2",
        init="cold",
        method="scp",
        tolerance=1e-6,
        formulation="condensed",
        algorithm="scvx",
        solver="CLARABEL",
        burns=[
            Burn(t_s=t, dv_m_s=tuple(dv))
            for t, dv in zip(mission.scenario.burns.times_s, burns.tolist(), strict=True)
        ],
        nodes=Nodes(
            t_s=mission.times_s.tolist(),
            state=mean.tolist(),
            covariance=np.broadcast_to(spread, (len(mean), 6, 6)).tolist(),
        ),
        stages=[],
        iterations=[],
        timing_s=PlanTiming(total=0.0, **nothing),
        verification=None,
        scenario=mission.scenario,
    )
