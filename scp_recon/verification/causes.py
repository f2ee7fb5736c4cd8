"""Judge flights by one rule, and say why a check fails; estimate the grid that is fine enough.

The planner takes steps of a fixed length, by default 232 s at most. Such steps are short enough
about Bennu. If a flight turns faster, they are too long, and the planner's path and covariances differ
from those of the verification.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace
from enum import Enum

import numpy as np

from formulations.linearisation.dynamics import Dynamics
from formulations.linearisation.linearisation import step_mean
from formulations.problem.flyby import Iterate
from scp_recon.mission.mission import Mission
from scp_recon.mission.scene import NODES_MAX
from scp_recon.monte_carlo.limits import ALL
from scp_recon.monte_carlo.summary import Interval, Summary, missed_by_law
from scp_recon.planning.plan import Plan
from scp_recon.results.figures import FINAL_SIGMAS, is_converged
from scp_recon.results.solution import Solution
from scp_recon.results.verification import Verification, in_words
from scp_recon.scenario.fields import ScenarioWarning
from scp_recon.scp.status import Status
from scp_recon.simulation.record import FlightSummary
from scp_recon.verification import reintegration
from scp_recon.verification.probabilities import falls_short, required_probability
from scp_recon.verification.reintegration import limits_of

SHOWN_S = 1.0
"""Distance from a node, s, beyond which a time counts as between nodes."""
INTEGRATION = 1e4
"""Factor on a limit beyond which an error is not one of integration: ten times finer steps would
not reduce it enough."""


class Cause(Enum):
    """Kinds of checks that can fail, each with its line."""

    STATUS = "planning did not converge"
    GRID = "integration errs on this grid"
    BETWEEN = "it falls short between nodes"
    BURNS = "the burns do not keep it"
    SHORT = "flights reach less than was required"
    BY_LAW = "flights reach less than the linear law, with which exact risk is planned"
    CERTIFICATE = "flights do not certify the plan"
    SPREAD = "flights spread more than the limit"
    COMMANDS = "corrections break it too often"
    UNEXECUTED = "too small to be executed, and planning found no plan without"
    DRIFT = "drifts come nearer than by the linear law"
    CONTRADICTION = "the file contradicts its own scenario and burns"


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
    """Lines with the names of a plan's failed checks and their cause."""
    unsolved = "status" in verification.failed  # whatever else falls short does so for that
    names: dict[str, list[str]] = {}
    for name in verification.failed:
        kind = Cause.STATUS if unsolved else kind_of(name, mission, verification)
        names.setdefault(kind.value, []).append(name)
    return tuple(f"{', '.join(map(in_words, failed))}: {line}" for line, failed in names.items())


def kind_of(name: str, mission: Mission, verification: Verification) -> Cause:
    """The kind of a check by its name."""
    if name in ("status", "certificate"):
        return Cause[name.upper()]
    limits = limits_of(mission)
    if name in limits:
        is_of_grid = getattr(verification, name) < INTEGRATION * limits[name]
        return Cause.GRID if is_of_grid else Cause.CONTRADICTION
    if name in {final for final, _, _ in FINAL_SIGMAS}:
        return Cause.SPREAD
    if name in {str(limit) for limit in verification.burn_limits}:
        return Cause.COMMANDS
    if name in {drift.check for drift in verification.drifts}:
        return Cause.DRIFT
    if name.startswith("dv_min of burn"):
        return Cause.UNEXECUTED
    short = Cause.BY_LAW if mission.scenario.risk.allocation == "exact" else Cause.SHORT
    worst = {f"P({p.name})": (short, p.worst_t_s) for p in verification.probabilities}
    worst |= {m.name: (Cause.BURNS, m.worst_t_s) for m in verification.mean_margins}
    if name not in worst:  # a part of the file
        return Cause.CONTRADICTION
    kind, time = worst[name]
    return Cause.BETWEEN if np.abs(mission.times_s - time).min() > SHOWN_S else kind


def needed_step_s(mission: Mission, verification: Verification) -> float:
    """The spacing of nodes at which every figure of the integration is within its limit, s."""
    limits = limits_of(mission)
    excess = max((getattr(verification, name) or 0.0) / limit for name, limit in limits.items())
    return finer_step_s(mission, excess)


SHORT_WH = 1e-9
"""Largest energy that counts as none, Wh."""


def shortfalls(found: Summary | FlightSummary, solution: Solution) -> list[str]:
    """List requirements that flights do not meet, as value and required value; empty if none.

    Args:
        found: of many flights, whose probabilities are compared with the required one, those of whole
            flights if the scope is the whole flight; or of one simulated flight, whose charge must stay
            above the vehicle's floor with every load served, and whose modes must have the length and
            the steady attitude that the schedule's rules require.
        solution: that was flown; it must have converged.
    """
    failed = []
    if not is_converged(solution):
        failed.append(f"the plan is {solution.status}, required {Status.CONVERGED.value.name}")
    if isinstance(found, Summary):
        return [*failed, *_of_flights(found, solution)]
    return [*failed, *_of_simulation(found, solution)]


def _of_flights(summary: Summary, solution: Solution) -> list[str]:
    probabilities: list[tuple[str, Interval]] = [
        (f"{name} {{:.4f}} at {lowest.worst_t_s:.0f} s", lowest)
        for name, lowest in summary.probability.items()
        if name != ALL
    ]
    if summary.commanded:
        probabilities += [
            (f"{name} of burn {burn.burn} {{:.4f}}", kept)
            for burn in summary.commanded.burns
            for name, kept in burn.limits.items()
        ]
    if solution.scenario.risk.scope == "flight":
        probabilities.append(("whole flights {:.4f}", summary.whole_flight))
    required, drift, found = required_probability(solution), summary.drift, []
    if drift is not None and drift.is_refuted:
        found.append(f"{drift.check} {drift.value:.4f}, required {drift.required:g}")
    return found + [
        f"{line.format(one.value)}, required {required:g}"
        for line, one in probabilities
        if falls_short(solution, one.value, one.high, required)
    ]


def _of_simulation(summary: FlightSummary, solution: Solution) -> list[str]:
    failed = []
    charge, floor = summary.least_charge, summary.floor_charge
    if charge < floor:
        failed.append(f"least state of charge {charge:.3f}, required {floor:.2f}")
    if (short := summary.energy_wh.short) > SHORT_WH:
        failed.append(f"{short:.3g} Wh short, required 0")
    rule = solution.scenario.schedule.attitude_s
    for leg in summary.legs:
        name = f"{leg.mode} mode from {leg.start_s:.0f} s"
        if not leg.ok:
            failed.append(f"{name} {leg.duration_s:.0f} s long, required {leg.required_s:.0f} s")
        if not leg.settled_in_time:
            after = "never" if leg.settled_s is None else f"after {leg.settled_s:.0f} s"
            failed.append(f"{name} steady {after}, required {rule:.0f} s")
    return failed


ORDER = 4
"""Order of the Runge-Kutta scheme: steps of half the length err by a sixteenth."""
AIM = 0.5
"""Share of a limit that a finer grid should reach."""


def integration_error(plan: Plan) -> tuple[float, float]:
    """Estimate a plan's largest integration errors from steps of half the length.

    The relative one of a node's covariance; and that of a node, m, velocities in the nondimensional
    problem's units.
    """
    mission, at = plan.mission, plan.final.result.lin
    halves = replace(mission.flow, substeps=2 * mission.flow.substeps)
    dynamics = Dynamics(halves, mission.burn_nodes)
    burns, halved = at.iterate.burns, dynamics.linearise(at.problem, at.iterate)
    flown = dynamics.linearise(
        at.problem, Iterate(burns, step_mean(halved, burns), at.iterate.gains)
    )
    coarse, fine = (lin.factor @ lin.factor.transpose(0, 2, 1) for lin in (at, flown))
    apart = np.abs(flown.iterate.mean - at.iterate.mean).max() * mission.units.length_m
    known = 1.0 - 0.5**ORDER
    return reintegration.relative_error(coarse, fine) / known, float(apart) / known


def finer_step_s(mission: Mission, excess: float) -> float:
    """Longest spacing of nodes with half of the allowed integration error, s.

    `excess` is the error on the mission's present grid over the one allowed.
    """
    longest = float(np.diff(mission.times_s).max()) / mission.arc_substeps
    step = longest * (AIM / max(excess, AIM)) ** (1.0 / ORDER)
    return max(1.0, float(np.floor(step)))


def refined(plan: Plan) -> Mission | None:
    """The mission of a plan on a grid fine enough for re-integration, with a warning about it.

    None if the present grid is fine enough, if the plan has not converged, or if the finer grid
    would have too many nodes.
    """
    mission, limits = plan.mission, reintegration.limits_of(plan.mission)
    if plan.status is not Status.CONVERGED:
        return None
    covariance, path_m = integration_error(plan)
    of_covariances = covariance / limits["covariance_error"]
    excess = max(of_covariances, path_m / limits["max_defect"])
    if excess <= 1.0:
        return None
    step, before = finer_step_s(mission, excess), mission.scenario.grid.step_max_s
    if mission.scenario.duration_s / step > NODES_MAX or step >= before:
        return None
    said, limit = f"covariances err by {covariance:.1e}", f"{limits['covariance_error']:g}"
    if of_covariances < excess:
        said, limit = f"nodes err by {path_m:.1e} m", f"{limits['max_defect']:g} m"
    word = ScenarioWarning.of(
        "grid.step_max_s",
        f"{before:g} s, with which {said}",
        f"expected at most {limit}: planned again with {step:g} s",
    )
    return mission.changed({"grid.step_max_s": step}, word)
