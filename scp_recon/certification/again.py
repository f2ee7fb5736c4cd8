"""Plan again until drifts are safe, and pictures of landmarks inform as much as the plan assumes.

Within a day the curvature of the flow moves drifts by a part of their spread, so that the linear law is
optimistic or pessimistic by some hundredths of a standard deviation. As certification does for the
flight, the difference is measured and added to the quantile that the plan's rows require.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
from scipy.special import ndtri

from formulations.arrays import Array, Indices
from formulations.linearisation.linearisation import Linearisation
from formulations.problem.flyby import Drift
from formulations.rows.drift import REACH, branch_at, start_of
from scp_recon.mission.constraints import Miss, drift_duration_s, drift_probability, planned_misses
from scp_recon.mission.mission import Mission
from scp_recon.monte_carlo.drifts import fly_drifts
from scp_recon.monte_carlo.estimates import proportion
from scp_recon.monte_carlo.sampling import Flyer
from scp_recon.monte_carlo.strata import drawn_factor
from scp_recon.planning.plan import Plan
from scp_recon.results.policy import SAME, misjudged, policy_of
from scp_recon.scp.status import Status

FLIGHTS, SEED = 20_000, 3_000
"""Flights that measure a drift's probability; no other draws begin at this seed."""

NEAREST = 0.05
"""Share of the flights, the nearest by the linear law, that are flown. In four random scenarios the
nearest 2 % had all of the 60 to 64 unsafe ones of 20,000."""

NEAR = 0.5
"""Margin of a drift, in standard deviations, beyond which its flights are not looked at. The law may
miss what the flow bends where it sees more room than its tangent planes: after the last burn of the
default scenario, cut at 0.9, it saw no flight inside, and 43 % came there within the day."""

BLIND = 2_000
"""Flights that judge a drift which is near by its tangent planes alone."""

RESOLVED = 0.04
"""Standard deviations below which a loss is left: what the flights resolve at 0.997."""

SMALL = 0.1
"""Standard deviations below which a loss hardly changes with the next plan: it is not measured anew."""

ROUNDS_MAX = 3
"""Times that a plan is made again for the safety of its drifts."""


def with_safe_drifts(mission: Mission, make: Callable[[Mission, Plan | None], Plan]) -> Plan:
    """Make a plan, and again as long as nonlinear drifts are less safe than required.

    `make` plans a mission, from an earlier plan if there is one. A mission whose plans are all unsafe
    ends infeasible; a plan that is unsafe where the law saw room is never the answer.
    """
    found = make(mission, None)
    for _ in range(ROUNDS_MAX):
        if found.status is not Status.CONVERGED or not (more := shortfalls(found)):
            break
        losses = dict(found.mission.drift_losses)
        for name, by in more.items():
            losses[name] = losses.get(name, 0.0) + by
        mission = replace(found.mission, drift_losses=tuple(losses.items()))
        again, seen = make(mission, found), max(more.values()) < np.inf
        if seen and again.status not in (Status.CONVERGED, Status.INFEASIBLE):
            break
        found = again
        if max(more.values()) < SMALL:
            break
    return found


def shortfalls(plan: Plan) -> dict[str, float]:
    """Standard deviations by which flights of drifts miss what is required, of those that miss it.

    Infinite where the linear law sees room that flights do not have.
    """
    lin, mission = plan.final.result.lin.with_drifts(plan.final.drifts), plan.mission
    asked = drift_probability(mission.scenario)
    needed, found = float(ndtri(asked)), dict[str, float]()
    near, blind = list[tuple[Miss, Drift]](), list[tuple[Miss, Drift]]()
    for miss, one in zip(planned_misses(mission.scenario), lin.problem.drifts, strict=True):
        if one.by_planes:
            continue
        if plan.final.margins[one.name].margin.min() < NEAR:
            near.append((miss, one))
        elif branch_at(lin, one).by_planes(start_of(lin, one)) < one.required + NEAR:
            blind.append((miss, one))
    if not (near or blind):
        return found
    config = Flyer(mission, plan.burns_m_s, policy_of(mission, lin), seed=SEED)
    draws = config.first_draws(FLIGHTS if near else BLIND)
    step_s = (
        drift_duration_s(mission.scenario) / lin.problem.drifts[0].flow.arcs
    )  # as the linear law's
    for miss, one in near:
        (flown,) = fly_drifts(config, [miss], draws[_nearest(lin, one, draws)], step_s)
        unsafe = int((~flown.safe(mission)).sum())
        short = needed - float(ndtri(1.0 - max(unsafe, 0.5) / FLIGHTS))
        if short > RESOLVED:
            found[one.name] = short
    drifted = fly_drifts(config, [miss for miss, _ in blind], draws[:BLIND], step_s)
    for (_, one), flown in zip(blind, drifted, strict=True):
        if proportion(int(flown.safe(mission).sum()), BLIND).high < asked:
            found[one.name] = np.inf
    return found


def _nearest(lin: Linearisation, one: Drift, draws: Array) -> Indices:
    """Numbers of the draws (n, sources) whose drifts come nearest by the linear law."""
    start, room = start_of(lin, one), np.full(len(draws), np.inf)
    mean, stm = branch_at(lin, one).flown(start.mean)
    off = start_of(lin, one, drawn_factor(lin)).factor @ draws.T
    for ball in one.keep_out:
        centred = mean[:, :3] - ball.center[: len(mean)]
        spread = np.linalg.norm(stm[:, :3] @ start.factor, axis=(1, 2))
        for node in np.flatnonzero(np.linalg.norm(centred, axis=1) - ball.radius < REACH * spread):
            apart = centred[node, :, None] + stm[node, :3] @ off
            room = np.minimum(room, np.sqrt(np.einsum("in,in->n", apart, apart)) - ball.radius)
    most = max(int(NEAREST * len(draws)), 2 * int((room < 0.0).sum()))
    return np.argsort(room)[:most].astype(np.intp)


PICTURE_ROUNDS_MAX = 4
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
    for _ in range(PICTURE_ROUNDS_MAX):
        policy = policy_of(found.mission, found.final.result.lin)
        if found.status is not Status.CONVERGED or not policy:
            break
        if misjudged(found.mission, policy, found.burns_m_s) <= SAME:
            break
        found = make(found.mission.along(found.burns_m_s), found)
    return found
