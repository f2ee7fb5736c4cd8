"""Correct the linear law of drifts by flights: raise what is required until nonlinear drifts are safe.

Within a day the curvature of the flow moves drifts by a part of their spread, so that the linear law is
optimistic or pessimistic by some hundredths of a standard deviation. As certification does for the
flight, the difference is measured and added to the quantile that the plan's rows require. Law and
dynamics are compared in the same flights at the same times, so that few flights suffice.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
from scipy.special import ndtr, ndtri

from formulations.problem.drift import Drift
from formulations.rows.drift import Branch, start_of
from scp_recon.mission.drifts import Miss, duration_s, planned, required_probability
from scp_recon.mission.mission import Mission
from scp_recon.monte_carlo.drifts import drift, states_after
from scp_recon.monte_carlo.flights import FlightConfig
from scp_recon.monte_carlo.sampling import BLOCK, draw_parameters, flown_mission
from scp_recon.planning.plan import Plan
from scp_recon.results.policy import policy_of
from scp_recon.scp.status import Status

FLIGHTS, SEED = 5_000, 3_000
"""Flights that measure how a drift differs from its law; no other draws begin at this seed."""

NEAREST = 0.1
"""Share of the flights, the nearest by the linear law, that are flown on through their drift."""

NEAR = 0.5
"""Margin of a drift, in standard deviations, beyond which its flights are not looked at."""

RESOLVED = 0.01
"""Standard deviations below which a loss is left: flights resolve several times as much."""

SMALL = 0.1
"""Standard deviations below which a loss hardly changes with the next plan: it is not measured anew."""

ROUNDS_MAX = 3
"""Times that a plan is made again for the safety of its drifts."""


def with_safe_drifts(mission: Mission, make: Callable[[Mission, Plan | None], Plan]) -> Plan:
    """Make a plan, and again as long as nonlinear drifts are less safe than required.

    `make` plans a mission, from an earlier plan if there is one. A mission whose plans are all unsafe
    ends infeasible.
    """
    found = make(mission, None)
    for _ in range(ROUNDS_MAX):
        if found.status is not Status.CONVERGED or not (more := shortfalls(found)):
            break
        losses = dict(found.mission.drift_losses)
        for name, by in more.items():
            losses[name] = losses.get(name, 0.0) + by
        mission = replace(found.mission, drift_losses=tuple(losses.items()))
        flown = found.final.result.lin.problem.drifts
        for old, new in zip(flown, mission.problem.drifts, strict=True):
            new.path[:] = old.path
        again = make(mission, found)
        if again.status not in (Status.CONVERGED, Status.INFEASIBLE):
            break
        found = again
        if max(more.values()) < SMALL:
            break
    return found


def shortfalls(plan: Plan) -> dict[str, float]:
    """Standard deviations by which flights of drifts miss what is required, of those that miss it."""
    lin, mission = plan.final.result.lin, plan.mission
    needed, found = float(ndtri(required_probability(mission.scenario))), {}
    for miss, one in zip(planned(mission.scenario), lin.problem.drifts, strict=True):
        margin = float(plan.final.margins[one.name].margin.min())
        if margin > NEAR:
            continue
        failing = float(ndtr(-one.required - margin)) + _lost(plan, one, miss)
        short = needed - float(ndtri(1.0 - max(failing, 0.5 / FLIGHTS)))
        if short > RESOLVED:
            found[one.name] = short
    return found


def _lost(plan: Plan, one: Drift, miss: Miss) -> float:
    """Share of drifts that fail, less the share that fails by the linear law in the same flights."""
    mission, lin, units = plan.mission, plan.final.result.lin, plan.mission.units.state
    config = FlightConfig(mission, plan.burns_m_s, SEED, policy=policy_of(mission, lin))
    (state,), start = states_after(config, [miss], FLIGHTS), start_of(lin, one)
    mean, stm = Branch(one, lin.problem.parameters).flown(start.mean)
    own = flown_mission(mission, SEED, FLIGHTS)
    off, room = (state / units - start.mean).T, np.full(len(state), np.inf)
    if own.deviation is not None:
        blocks = range(FLIGHTS // BLOCK)
        known = [draw_parameters(mission, SEED, block) for block in blocks]
        off = np.vstack([off, np.concatenate(known).T])
    for ball in one.keep_out:
        for node, centre in enumerate(ball.center[: len(mean)]):
            apart = (mean[node, :3] - centre)[:, None] + stm[node, :3] @ off
            room = np.minimum(room, np.sqrt(np.einsum("in,in->n", apart, apart)) - ball.radius)
    near = np.argsort(room)[: max(int(NEAREST * len(state)), 2 * int((room < 0.0).sum()))]
    begin = mission.scenario.burns.times_s[miss.burn - 1]
    step = duration_s(mission.scenario) / one.flow.arcs
    flown = drift(own.some_flights(near), config.truth, state[near], begin, step)
    return float((~flown.safe(mission)).sum() - (room < 0.0).sum()) / len(state)
