"""Give a remedy for each failed check, from one table for terminal, reports and drafts."""

from __future__ import annotations

import numpy as np

from scp_recon.mission.mission import Mission
from scp_recon.results.figures import FINAL_SIGMAS
from scp_recon.results.solution import Solution
from scp_recon.results.verification import Verification
from scp_recon.scp.status import Status
from scp_recon.verification.refinement import finer_step_s
from scp_recon.verification.reintegration import limits_of

SHOWN_S = 1.0
"""Distance from a node, s, beyond which a time counts as between nodes."""
INTEGRATION = 1e4
"""Factor on a limit beyond which an error is not one of integration: ten times finer steps would
not reduce it enough."""
STATUS, GRID, BETWEEN, BURNS, SHORT = "status", "grid", "between nodes", "burns", "short"
CERTIFICATE, SPREAD, COMMANDS, BY_LAW = "certificate", "spread", "commands", "short by law"
UNEXECUTED = "unexecuted"
DRIFT = "drift"
CONTRADICTION = "contradiction"
REMEDIES = {
    STATUS: "{remedy}",
    GRID: "integration errs: set grid.step_max_s={step:g}, and plan again",
    BETWEEN: "it falls short between nodes: take a smaller grid.step_max_s, or grid.nodes_s there",
    BURNS: "the burns do not keep it: plan again, from this file as init",
    SHORT: "flights reach less than was required: raise risk.p_chance, or set "
    'risk.allocation="exact", which flights certify',
    BY_LAW: "flights reach less than the linear law, with which exact risk is planned: let flights "
    "certify the plan, without --certify no, or raise risk.p_chance",
    CERTIFICATE: "flights do not certify the plan: take a lower risk.p_chance or a smaller "
    "uncertainty.execution_error, or plan again on a smaller grid.step_max_s",
    SPREAD: "flights spread more: raise the limit in boundary, or lower "
    "uncertainty.execution_error",
    COMMANDS: "corrections break it too often: raise burns.dv_max_m_s or take a smaller "
    'battery.delta_v_cone_deg, or set policy.kind="open"',
    UNEXECUTED: "too small to be executed, and planning found no plan without: lower "
    "burns.dv_min_m_s, or move burns.times_s",
    DRIFT: "drifts come nearer than by the linear law: certify the plan by flights, or raise "
    "safety.drift_probability",
    CONTRADICTION: "the file contradicts its own scenario and burns: plan again, from it as init",
}
"""One line for each kind of check that can fail."""

NAMES = {
    "risk": "stored probabilities",
    "certificate": "certificate by flights",
    "covariance_error": "covariance, re-integrated",
    "knowledge_error": "knowledge, re-integrated",
    "drift_error_m": "drifts, re-integrated",
    "max_defect": "nodes, re-integrated",
    "sample_error_m": "sampled flights, re-integrated",
    "terminal_position_error_m": "final position, re-integrated",
    "terminal_velocity_error_m_s": "final velocity, re-integrated",
}
"""Words for checks whose names are those of the file."""


def in_words(name: str) -> str:
    """A check in words, by its name in the file."""
    return NAMES.get(name, name)


def next_lines(mission: Mission, solution: Solution, verification: Verification) -> tuple[str, ...]:
    """What was found to work for a plan, else `what_next`."""
    return solution.advice or tuple(
        f"next: {line}" for line in what_next(mission, solution, verification)
    )


def what_next(mission: Mission, solution: Solution, verification: Verification) -> tuple[str, ...]:
    """Lines with the names of failed checks and a remedy for them.

    Args:
        mission: of the solution.
        solution: that was verified.
        verification: of it.
    """
    unsolved = STATUS in verification.failed  # whatever else falls short does so for that
    names: dict[str, list[str]] = {}
    for name in verification.failed:
        kind = STATUS if unsolved else kind_of(name, mission, verification)
        line = REMEDIES[kind].format(
            remedy=Status.named(solution.status).value.remedy, step=_step_s(mission, verification)
        )
        names.setdefault(line, []).append(name)
    return tuple(f"{', '.join(map(in_words, failed))}: {line}" for line, failed in names.items())


def kind_of(name: str, mission: Mission, verification: Verification) -> str:
    """The kind of a check by its name, a key of `REMEDIES`."""
    if name in (STATUS, CERTIFICATE):
        return name
    limits = limits_of(mission)
    if name in limits:
        return GRID if getattr(verification, name) < INTEGRATION * limits[name] else CONTRADICTION
    if name in {final for final, _, _ in FINAL_SIGMAS}:
        return SPREAD
    if name in {str(limit) for limit in verification.burn_limits}:
        return COMMANDS
    if name in {drift.check for drift in verification.drifts}:
        return DRIFT
    if name.startswith("dv_min of burn"):
        return UNEXECUTED
    short = BY_LAW if mission.scenario.risk.allocation == "exact" else SHORT
    worst = {f"P({p.name})": (short, p.worst_t_s) for p in verification.probabilities}
    worst |= {m.name: (BURNS, m.worst_t_s) for m in verification.mean_margins}
    if name not in worst:  # a part of the file
        return CONTRADICTION
    kind, time = worst[name]
    return BETWEEN if np.abs(mission.times_s - time).min() > SHOWN_S else kind


def _step_s(mission: Mission, verification: Verification) -> float:
    """The spacing of nodes at which every figure of the integration is within its limit, s."""
    limits = limits_of(mission)
    excess = max((getattr(verification, name) or 0.0) / limit for name, limit in limits.items())
    return finer_step_s(mission, excess)
