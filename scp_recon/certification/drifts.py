"""Correct the linear law of drifts by flights: raise what is required until nonlinear drifts are safe.

Within a day the curvature of the flow moves drifts by a part of their spread, so that the linear law is
optimistic or pessimistic by some hundredths of a standard deviation. As certification does for the
flight, the difference is measured and added to the quantile that the plan's rows require.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace

import numpy as np
from scipy.special import ndtri

from formulations.arrays import Array, Indices
from formulations.problem.drift import Drift
from formulations.rows.drift import REACH, branch_at, start_of
from scp_recon.mission.drifts import Miss, duration_s, planned, required_probability
from scp_recon.mission.mission import Mission
from scp_recon.monte_carlo.drifts import drift, states_after
from scp_recon.monte_carlo.estimates import proportion
from scp_recon.monte_carlo.flights import FlightConfig
from scp_recon.monte_carlo.sampling import BLOCK, draw_parameters
from scp_recon.planning.plan import Plan
from scp_recon.results.policy import policy_of
from scp_recon.scp.status import Status

FLIGHTS, SEED = 20_000, 3_000
"""Flights that measure a drift's probability; no other draws begin at this seed."""

NEAREST = 0.1
"""Share of the flights, the nearest by the linear law, that are flown on through their drift."""

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
    lin, mission = plan.final.result.lin, plan.mission
    asked = required_probability(mission.scenario)
    needed, found = float(ndtri(asked)), dict[str, float]()
    near, blind = list[tuple[Miss, Drift]](), list[tuple[Miss, Drift]]()
    for miss, one in zip(planned(mission.scenario), lin.problem.drifts, strict=True):
        if one.by_planes:
            continue
        if plan.final.margins[one.name].margin.min() < NEAR:
            near.append((miss, one))
        elif branch_at(lin, one).by_planes(start_of(lin, one)) < one.required + NEAR:
            blind.append((miss, one))
    config = FlightConfig(mission, plan.burns_m_s, SEED, policy=policy_of(mission, lin))
    for (miss, one), state, draws in _flown(config, near, FLIGHTS):
        nearest = _nearest(plan, one, state, draws)
        failing = max(_unsafe(config, miss, one, state[nearest], draws[nearest]), 0.5) / FLIGHTS
        if (short := needed - float(ndtri(1.0 - failing))) > RESOLVED:
            found[one.name] = short
    for (miss, one), state, draws in _flown(config, blind, BLIND):
        unsafe = _unsafe(config, miss, one, state, draws)
        if proportion(BLIND - unsafe, BLIND).high < asked:
            found[one.name] = np.inf
    return found


def _flown(
    config: FlightConfig, cases: Sequence[tuple[Miss, Drift]], flights: int
) -> Iterator[tuple[tuple[Miss, Drift], Array, Array]]:
    """Each case with the states of flights at its start, and the draws of their parameters."""
    if not cases:
        return
    blocks = range(-(-flights // BLOCK))
    draws = np.concatenate([draw_parameters(config.mission, SEED, block) for block in blocks])
    starts = states_after(config, [miss for miss, _ in cases], flights)
    yield from ((case, state, draws) for case, state in zip(cases, starts, strict=True))


def _unsafe(config: FlightConfig, miss: Miss, one: Drift, state: Array, draws: Array) -> int:
    """Number of drifts from states that are not safe, with steps as long as the linear law's."""
    scenario, deviating = config.mission.scenario, config.mission.of_flights(draws)
    begin, step = scenario.burns.times_s[miss.burn - 1], duration_s(scenario) / one.flow.arcs
    flown = drift(deviating, config.truth, state, begin, step)
    return int((~flown.safe(config.mission)).sum())


def _nearest(plan: Plan, one: Drift, state: Array, draws: Array) -> Indices:
    """Numbers of those states (n, 6) at a drift's start that come nearest by the linear law.

    `draws` are those of the uncertain parameters, shape (n, p).
    """
    lin, mission = plan.final.result.lin, plan.mission
    start, room = start_of(lin, one), np.full(len(state), np.inf)
    mean, stm = branch_at(lin, one).flown(start.mean)
    off = np.vstack([(state / mission.units.state - start.mean).T, draws.T])
    for ball in one.keep_out:
        centred = mean[:, :3] - ball.center[: len(mean)]
        spread = np.linalg.norm(stm[:, :3] @ start.factor, axis=(1, 2))
        for node in np.flatnonzero(np.linalg.norm(centred, axis=1) - ball.radius < REACH * spread):
            apart = centred[node, :, None] + stm[node, :3] @ off
            room = np.minimum(room, np.sqrt(np.einsum("in,in->n", apart, apart)) - ball.radius)
    most = max(int(NEAREST * len(state)), 2 * int((room < 0.0).sum()))
    return np.argsort(room)[:most].astype(np.intp)
