"""Say why a check fails, from one table for terminal and reports."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np

from scp_recon.mission.mission import Mission
from scp_recon.monte_carlo.summary import missed_by_law
from scp_recon.results.figures import FINAL_SIGMAS, is_converged
from scp_recon.results.solution import Solution
from scp_recon.results.verification import Verification, in_words
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
CAUSES = {
    STATUS: "planning did not converge",
    GRID: "integration errs on this grid",
    BETWEEN: "it falls short between nodes",
    BURNS: "the burns do not keep it",
    SHORT: "flights reach less than was required",
    BY_LAW: "flights reach less than the linear law, with which exact risk is planned",
    CERTIFICATE: "flights do not certify the plan",
    SPREAD: "flights spread more than the limit",
    COMMANDS: "corrections break it too often",
    UNEXECUTED: "too small to be executed, and planning found no plan without",
    DRIFT: "drifts come nearer than by the linear law",
    CONTRADICTION: "the file contradicts its own scenario and burns",
}
"""One line for each kind of check that can fail."""

UNTRIED = (
    "no remedy was tried; solve --init FILE plans from this plan, and tries some if it fails again"
)
"""What follows causes where no advice was looked for."""
IMPACT_WARNED = 0.01
"""Share of flights that hit the body after a missed burn, from which on it is a warning."""


def in_doubt(
    solution: Solution, v: Verification | None, warnings: Iterable[object] = ()
) -> list[str]:
    """Warnings on a scenario, and what a verification warns of even if it holds; each once."""
    said = [str(warning) for warning in warnings]
    if v is not None:
        nearest = v.nearest_drift
        if nearest is not None and nearest.impact >= IMPACT_WARNED:
            said.append(f"{nearest} of flights hit the body")
        if is_converged(solution) and (missed := missed_by_law(v.wider or {})):
            said.append(missed)
    return list(dict.fromkeys(said))


def next_lines(mission: Mission, solution: Solution, verification: Verification) -> tuple[str, ...]:
    """What was found to work for a plan, else why its checks fail."""
    if solution.advice or verification.ok:
        return solution.advice
    return (*causes(mission, verification), UNTRIED)


def causes(mission: Mission, verification: Verification) -> tuple[str, ...]:
    """Lines with the names of failed checks and their cause.

    Args:
        mission: of the plan.
        verification: of it.
    """
    unsolved = STATUS in verification.failed  # whatever else falls short does so for that
    names: dict[str, list[str]] = {}
    for name in verification.failed:
        kind = STATUS if unsolved else kind_of(name, mission, verification)
        names.setdefault(CAUSES[kind], []).append(name)
    return tuple(f"{', '.join(map(in_words, failed))}: {line}" for line, failed in names.items())


def kind_of(name: str, mission: Mission, verification: Verification) -> str:
    """The kind of a check by its name, a key of `CAUSES`."""
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


def needed_step_s(mission: Mission, verification: Verification) -> float:
    """The spacing of nodes at which every figure of the integration is within its limit, s."""
    limits = limits_of(mission)
    excess = max((getattr(verification, name) or 0.0) / limit for name, limit in limits.items())
    return finer_step_s(mission, excess)
