"""Fly the drift after a burn that is missed or cut short, with the nonlinear dynamics.

The flights up to the burn have the same draws as flights without a miss.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from formulations.arrays import Array, Booleans
from scp_recon.mission.constraints import (
    JUDGED_STEP_S,
    Miss,
    attitudes_left_s,
    companion_distance_m,
    drift_duration_s,
    drift_radius_m,
)
from scp_recon.mission.mission import Mission
from scp_recon.mission.scene import TruthModel
from scp_recon.monte_carlo.estimates import proportion
from scp_recon.monte_carlo.sampling import BLOCK, Flyer, flow_of
from scp_recon.results.verification import DriftSafety

NEAREST = 0.003
"""Share of flights that come nearer than the distance that is reported."""


@dataclass(frozen=True, eq=False)
class Drifted:
    """Nearest approaches of drifts, shape (flights,) each.

    Attributes:
        closest_m: distance from the body's centre.
        at_s: its time past the epoch.
        apart_m: distance from the companion's centre, infinite without one.
        spell_s: time flown.
    """

    closest_m: Array
    at_s: Array
    apart_m: Array
    spell_s: float

    def safe(self, mission: Mission) -> Booleans:
        """Drifts that keep both distances."""
        clear = self.apart_m >= companion_distance_m(mission.scenario)
        return clear & (self.closest_m >= drift_radius_m(mission.scenario))


def fly_drifts(
    config: Flyer, misses: Sequence[Miss], draws: Array, step_s: float = JUDGED_STEP_S
) -> list[Drifted]:
    """Fly drifts of several misses, each from the same flights, with draws (flights, sources)."""
    if not misses:
        return []
    mission, initial = config.mission, config.mission.initial_factor.shape[1]
    own = mission.of_flights(draws[:, initial : initial + mission.uncertain.count])
    times = [mission.scenario.burns.times_s[miss.burn - 1] for miss in misses]
    starts = states_after(config, misses, draws)
    return [drift(own, config.truth, *at, step_s) for at in zip(starts, times, strict=True)]


def states_after(config: Flyer, misses: Sequence[Miss], draws: Array) -> list[Array]:
    """States of draws just after each missed or cut burn, J2000, m and m/s, (flights, 6) each."""
    scenario, parts = config.mission.scenario, []
    times = np.unique([scenario.burns.times_s[miss.burn - 1] for miss in misses])
    for first in range(0, len(draws), BLOCK):
        flown = config.fly(times, draws[first : first + BLOCK], until_s=times[-1])
        part = []
        for miss in misses:
            at = np.searchsorted(times, scenario.burns.times_s[miss.burn - 1])
            state, burn = flown.states[at].copy(), miss.burn - 1 - scenario.burns_flown
            state[:, 3:] -= (1.0 - miss.share) * flown.burns_m_s[:, burn]
            part.append(state)
        parts.append(part)
    return [np.concatenate(states) for states in zip(*parts, strict=True)]


def drift(
    mission: Mission, truth: TruthModel, state: Array, start_s: float, step_s: float = JUDGED_STEP_S
) -> Drifted:
    """Fly free drifts from states (flights, 6) at a time, J2000, m and m/s."""
    flow, companion = flow_of(mission, truth), mission.scene.companion
    spell_s = reach_s(mission)
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
                away = r - np.atleast_2d(companion.position(time)).T
                apart = np.fmin(apart, np.einsum("in,in->n", away, away))
            if k < steps:
                r, v = flow(r, v, time, step)
    return Drifted(np.sqrt(closest), at, np.sqrt(apart), spell_s)


def reach_s(mission: Mission) -> float:
    """Time of a drift, s: the scenario's, as far as a table of attitudes goes after the last burn."""
    return min(drift_duration_s(mission.scenario), attitudes_left_s(mission.scene))


def safety_of(
    mission: Mission, miss: Miss, drifted: Drifted, required: float | None
) -> DriftSafety:
    """How safe drifts are, with the probability that is required of them, if any."""
    order = np.argsort(drifted.closest_m)
    nearest = order[int(NEAREST * len(order))]
    inside = drifted.closest_m < mission.scenario.body.reference_radius_m
    safe = drifted.safe(mission)
    return DriftSafety(
        burn=miss.burn,
        share=miss.share,
        drift_s=drifted.spell_s,
        radius_m=drift_radius_m(mission.scenario),
        required=required,
        **proportion(int(safe.sum()), len(safe))._asdict(),
        closest_m=float(drifted.closest_m[nearest]),
        closest_t_s=float(drifted.at_s[nearest]),
        impact=float(inside.mean()),
    )
