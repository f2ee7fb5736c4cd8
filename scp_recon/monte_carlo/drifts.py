"""Fly the drift after a burn that is missed or cut short, with the nonlinear dynamics.

The flights up to the burn are those of `sampling.fly_block`, with the same draws: flights without a
miss stay as they are.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from formulations.arrays import Array, Booleans
from scp_recon.mission.constraints import companion_distance_m
from scp_recon.mission.drifts import STEP_S, Miss, duration_s, radius_m
from scp_recon.mission.mission import Mission
from scp_recon.mission.scene import TruthModel
from scp_recon.monte_carlo.estimates import proportion
from scp_recon.monte_carlo.sampling import BLOCK, AnyPolicy, flow_of, fly_block
from scp_recon.results.facts import DriftSafety

NEAREST = 0.003
"""Share of flights that come nearer than the distance that is reported."""


@dataclass(frozen=True, eq=False)
class Drifted:
    """Nearest approaches of drifts, shape (flights,) each.

    Attributes:
        closest_m: distance from the body's centre.
        at_s: its time past the epoch.
        apart_m: distance from the companion's centre, infinite without one.
    """

    closest_m: Array
    at_s: Array
    apart_m: Array

    def safe(self, mission: Mission) -> Booleans:
        """Drifts that keep both distances."""
        clear = self.apart_m >= companion_distance_m(mission.scenario)
        return clear & (self.closest_m >= radius_m(mission.scenario))


def fly_drifts(
    mission: Mission,
    burns_m_s: Array,
    misses: Sequence[Miss],
    flights: int,
    *,
    seed: int = 0,
    truth: TruthModel = "planner",
    policy: AnyPolicy = (),
    step_s: float = STEP_S,
    spell_s: float | None = None,
) -> list[Drifted]:
    """Fly drifts of several misses, each from the same flights: see `states_before`."""
    firing = np.array([mission.scenario.burns.times_s[miss.burn - 1] for miss in misses])
    starts = states_after(
        mission, burns_m_s, misses, flights, seed=seed, truth=truth, policy=policy
    )
    spell = reach_s(mission, spell_s or duration_s(mission.scenario))
    return [
        drift(mission, state, time, spell, truth=truth, step_s=step_s)
        for state, time in zip(starts, firing.tolist(), strict=True)
    ]


def states_after(
    mission: Mission,
    burns_m_s: Array,
    misses: Sequence[Miss],
    flights: int,
    *,
    seed: int = 0,
    truth: TruthModel = "planner",
    policy: AnyPolicy = (),
) -> list[Array]:
    """States of flights just after each missed or cut burn, J2000, m and m/s, (flights, 6) each."""
    scenario, parts = mission.scenario, []
    times = np.unique([scenario.burns.times_s[miss.burn - 1] for miss in misses])
    for first in range(0, flights, BLOCK):
        flown = fly_block(
            mission,
            burns_m_s,
            times,
            first // BLOCK,
            flights=min(BLOCK, flights - first),
            seed=seed,
            truth=truth,
            policy=policy,
        )
        part = []
        for miss in misses:
            at = np.searchsorted(times, scenario.burns.times_s[miss.burn - 1])
            state, burn = flown.states[at].copy(), miss.burn - 1 - scenario.burns_flown
            state[:, 3:] -= (1.0 - miss.share) * flown.burns_m_s[:, burn]
            part.append(state)
        parts.append(part)
    return [np.concatenate(states) for states in zip(*parts, strict=True)]


def drift(
    mission: Mission,
    state: Array,
    start_s: float,
    spell_s: float,
    *,
    truth: TruthModel = "planner",
    step_s: float = STEP_S,
) -> Drifted:
    """Fly free drifts from states (flights, 6) at a time, J2000, m and m/s."""
    flow, companion = flow_of(mission, truth), mission.scene.companion
    r, v = (np.ascontiguousarray(half.T) for half in (state[:, :3], state[:, 3:]))
    steps = max(1, int(np.ceil(spell_s / step_s - 1e-9)))
    step, n = spell_s / steps, len(state)
    closest, apart, at = np.full(n, np.inf), np.full(n, np.inf), np.full(n, start_s)
    # A flight through the body may end anywhere: its nearest approach is counted before.
    with np.errstate(all="ignore"):
        for k in range(steps + 1):
            time = start_s + k * step
            square = np.einsum("in,in->n", r, r)
            nearer = square < closest
            closest, at = np.where(nearer, square, closest), np.where(nearer, time, at)
            if companion is not None:
                away = r - companion.position(time)[:, None]
                apart = np.fmin(apart, np.einsum("in,in->n", away, away))
            if k < steps:
                r, v = flow(r, v, time, step)
    return Drifted(np.sqrt(closest), at, np.sqrt(apart))


def reach_s(mission: Mission, spell_s: float) -> float:
    """Time for which a drift after the last burn can be flown: as far as a table of attitudes goes."""
    table = getattr(mission.rotation, "table", None)
    if table is None:
        return spell_s
    end = float(table.tdb_s[-1]) - mission.rotation.epoch_s  # type: ignore[attr-defined]
    return float(min(spell_s, end - mission.scenario.duration_s))


def safety_of(
    mission: Mission, miss: Miss, drifted: Drifted, required: float | None, spell_s: float
) -> DriftSafety:
    """How safe drifts are, with the probability that is required of them, if any."""
    order = np.argsort(drifted.closest_m)
    nearest = order[int(NEAREST * len(order))]
    inside = drifted.closest_m < mission.scenario.body.reference_radius_m
    safe = drifted.safe(mission)
    return DriftSafety(
        burn=miss.burn,
        share=miss.share,
        drift_s=spell_s,
        radius_m=radius_m(mission.scenario),
        required=required,
        **proportion(int(safe.sum()), len(safe))._asdict(),
        closest_m=float(drifted.closest_m[nearest]),
        closest_t_s=float(drifted.at_s[nearest]),
        impact=float(inside.mean()),
    )
