"""State the observation constraints of the paper as data: Echigo et al., eqs. (12) to (16).

The planner makes regions of them, the Monte Carlo margins. Verification states them independently.

A drift is the free flight after a burn that does not happen, or that is cut short; safety: L. S. Breger
and J. P. How, "Safe trajectories for autonomous rendezvous of spacecraft", Journal of Guidance,
Control, and Dynamics 31 (2008) 1478. A drift is a scenario, not a chance: each one keeps its distance
with the required probability.
"""

from __future__ import annotations

from collections.abc import Container, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np

from formulations.arrays import Array, Indices
from formulations.problem.facets import quantile, split_risk
from formulations.problem.flyby import Drift, StateConstraint
from formulations.problem.regions import Ball, Cone
from scp_recon.display import exact
from scp_recon.errors import InputError, option
from scp_recon.mission.knowledge import Uncertain, companion_motion, region_motions
from scp_recon.mission.scene import NODES_MAX, Scene, Units
from scp_recon.physics.flow import GridFlow
from scp_recon.physics.forces import ForceModel, Partials
from scp_recon.physics.frames import TabulatedRotation
from scp_recon.physics.geometry import track
from scp_recon.scenario.schema import DRIFT_PROBABILITY, DRIFT_S, Scenario

Measure = Literal["distance", "emission", "phase"]
Sense = Literal["min", "max"]
Beyond = Literal["drifts", "feedback", "knowledge", "final sigma"]
AS_PRINTED: tuple[Beyond, ...] = ("feedback", "knowledge", "final sigma")
"""What the paper's own problem does not have, except drifts."""


@dataclass(frozen=True)
class Limit:
    """A lower or upper limit on the position relative to the site.

    It bounds the distance from the site, m, or the angle at the site to its normal (emission) or to the
    Sun (phase), rad.

    Attributes:
        name: of the limit, such as emission_max.
        measure: what it bounds.
        sense: whether it is the lower or the upper limit.
        value: of it, m or rad.
    """

    name: str
    joint: str
    """Chance constraint that this limit belongs to."""
    measure: Measure
    sense: Sense
    value: float

    @property
    def unit(self) -> Literal["m", "rad"]:
        """Unit of the value and of margins."""
        return "m" if self.measure == "distance" else "rad"

    def margin(self, measured: Array) -> Array:
        """Margin to the limit, >= 0 where the limit holds."""
        return measured - self.value if self.sense == "min" else self.value - measured


SAFETY, COMPANION = "safety_radius", "companion_distance"
"""Constraints that count throughout the flight."""


def require_without(refused: Container[Beyond], scenario: Scenario, needs: str) -> None:
    """Refuse what a scenario has beyond a plan as printed, where it goes with `needs` alone.

    Raises:
        InputError: if the scenario has any of what is refused.
    """
    safety, boundary = scenario.safety, scenario.boundary
    given: list[tuple[Beyond, str, str | None]] = [
        ("drifts", "safety.missed_burns", "1" if safety.missed_burns else None),
        ("drifts", "safety.cut_short", "true" if safety.cut_short else None),
        ("feedback", "policy.kind", "'feedback'" if scenario.policy.kind == "feedback" else None),
    ]
    for entry, sigmas in Uncertain.of(scenario).sigmas.items():
        given.append(("knowledge", f"knowledge.{entry}", ", ".join(map(exact, sigmas))))
    for name in ("final_sigma_position_m", "final_sigma_velocity_m_s"):
        limit = getattr(boundary, name)
        given.append(("final sigma", f"boundary.{name}", None if limit is None else exact(limit)))
    for what, entry, found in given:
        if what in refused and found is not None:
            raise InputError(entry, found, f"goes with {needs}")


def companion_distance_m(scenario: Scenario) -> float:
    """Least distance from the companion's centre, m; zero without one."""
    companion = scenario.body.companion
    own = 0.0 if companion is None else companion.radius_m
    return scenario.safety.companion_distance_min_m or own


def safety_margins(scene: Scene, times_s: Array, position: Array) -> dict[str, Array]:
    """Margins of the safety distances, m, for positions (n, ..., 3) at times (n,)."""
    scenario = scene.scenario
    found = {SAFETY: np.linalg.norm(position, axis=-1) - scenario.safety.radius_min_m}
    if scene.companion is not None:
        centre = scene.companion.position(times_s.reshape(-1, *[1] * (position.ndim - 2)))
        apart = np.linalg.norm(position - centre, axis=-1)
        found[COMPANION] = apart - companion_distance_m(scenario)
    return found


def observation_limits(scenario: Scenario) -> tuple[Limit, ...]:
    """All limits in the window; the battery's cone of observation is a least phase angle."""
    o, battery = scenario.observation, scenario.battery.observation_cone_deg
    rows: tuple[tuple[str, Measure, Sense, float | None], ...] = (
        ("site_distance", "distance", "min", o.site_distance_min_m),
        ("site_distance", "distance", "max", o.site_distance_max_m),
        ("emission", "emission", "min", o.emission_min_deg),
        ("emission", "emission", "max", o.emission_max_deg),
        ("phase", "phase", "min", o.phase_min_deg),
        ("battery_observation", "phase", "min", battery),
        ("phase", "phase", "max", o.phase_max_deg),
    )
    return tuple(
        Limit(
            name=joint if joint == "battery_observation" else f"{joint}_{sense}",
            joint=joint,
            measure=measure,
            sense=sense,
            value=value if measure == "distance" else float(np.deg2rad(value)),
        )
        for joint, measure, sense, value in rows
        if value is not None
    )


def required_of_mean(scenario: Scenario, limits: Sequence[Limit]) -> dict[str, tuple[Sense, float]]:
    """Sense and value of each requirement on the mean, in m, m/s or rad, by constraint."""
    found: dict[str, tuple[Sense, float]] = {
        SAFETY: ("min", scenario.safety.radius_min_m),
        "dv_max": ("max", scenario.burns.dv_max_m_s),
        "dv_battery": ("min", float(np.deg2rad(scenario.battery.delta_v_cone_deg))),
    }
    if scenario.body.companion is not None:
        found[COMPANION] = "min", companion_distance_m(scenario)
    return found | {limit.name: (limit.sense, limit.value) for limit in limits}


def required_in_words(scenario: Scenario) -> str:
    """Required probability, and of what."""
    risk = scenario.risk
    if risk.scope == "flight":
        return f"at least {risk.p_chance:g} of whole flights keep every limit"
    return f"every limit at every node with at least {risk.p_chance:g}"


def state_constraints(
    scene: Scene,
    limits: Sequence[Limit],
    uncertain: Uncertain,
    times_s: Array,
    window: Indices,
    length_m: float,
) -> tuple[StateConstraint, ...]:
    """Build the nondimensional state constraints: safety at every node, the limits in the window.

    Args:
        scene: where the limits are.
        limits: of the observation.
        uncertain: parameters, with which the regions of limits move.
        times_s: of the nodes, shape (n,).
        window: nodes of the window.
        length_m: unit of length.
    """
    scenario, observed_s = scene.scenario, times_s[window]
    p, everywhere = scenario.risk.p_chance, np.arange(len(times_s))
    body = Ball(np.zeros((len(times_s), 3)), scenario.safety.radius_min_m / length_m)
    found = [StateConstraint(SAFETY, everywhere, body, "out", p)]
    if (companion := scene.companion) is not None:
        centre = companion.position(times_s) / length_m
        ball = Ball(centre, companion_distance_m(scenario) / length_m)
        moved = companion_motion(uncertain, companion, times_s, length_m)
        found.append(StateConstraint(COMPANION, everywhere, ball, "out", p, motion=moved))
    if not len(window):  # which is over for a flight that is under way
        return tuple(found)
    site = track(scene.site, scene.rotation, observed_s)
    at = site.position / length_m
    axes = {"emission": site.normal, "phase": scene.sun_direction(observed_s)}
    motions = region_motions(uncertain, scene.site, scene.rotation, observed_s, length_m)
    for limit in limits:
        region = (
            Ball(at, limit.value / length_m)
            if limit.measure == "distance"
            else Cone(at, axes[limit.measure], limit.value)
        )
        # A two-sided constraint splits its risk in two.
        share = split_risk(p, sum(other.joint == limit.joint for other in limits))
        keep: Literal["in", "out"] = "out" if limit.sense == "min" else "in"
        found.append(
            StateConstraint(
                limit.name, window, region, keep, share, limit.joint, motions.get(limit.measure)
            )
        )
    return tuple(found)


# --- drifts -----------------------------------------------------------------------------------------

JUDGED_STEP_S = 120.0
"""Spacing of the times at which flights of a drift are judged, s."""

NODE_SHARE = 0.1
"""Spacing of a drift's nodes in the linear law, over sqrt(R^3 / GM) at the radius R that it keeps:
500 s at 500 m from Bennu. There a quarter of it moves the probability of a drift by 0.001 standard
deviations, and the lines along which that is estimated err by 0.02."""

CUTS = 0.1, 0.3, 0.5, 0.7, 0.9
"""Shares of a burn at which `safety.cut_short` stops it."""


@dataclass(frozen=True)
class Miss:
    """A burn of which only a share happens; no burn follows.

    Attributes:
        burn: number of the burn in the whole flight, from 1.
        share: of it that happens; 0 where it is missed.
    """

    burn: int
    share: float = 0.0

    @property
    def name(self) -> str:
        """Name of its drift among the constraints."""
        return (
            f"cut_burn_{self.burn}_at_{self.share:g}" if self.share else f"missed_burn_{self.burn}"
        )

    @property
    def event(self) -> str:
        """What happens, in words."""
        how = f"stops at {100.0 * self.share:g} %" if self.share else "is missed"
        return f"burn {self.burn} {how}"


def drift_duration_s(scenario: Scenario) -> float:
    """Time for which a drift must be safe, s."""
    return scenario.safety.drift_s or DRIFT_S


def drift_radius_m(scenario: Scenario) -> float:
    """Least distance of a drift from the body's centre, m."""
    return scenario.safety.drift_radius_m or scenario.safety.radius_min_m


def planned_misses(scenario: Scenario) -> tuple[Miss, ...]:
    """Misses that a plan must survive: of all burns left but the first of the flight."""
    safety, flown = scenario.safety, scenario.burns_flown
    numbers = range(max(2, 1 + flown), 1 + len(scenario.burns.times_s))
    shares = (*((0.0,) if safety.missed_burns else ()), *(CUTS if safety.cut_short else ()))
    return tuple(Miss(number, share) for number in numbers for share in shares)


def _step_s(scenario: Scenario) -> float:
    """Longest arc of a drift, s."""
    return float(NODE_SHARE * np.sqrt(drift_radius_m(scenario) ** 3 / scenario.body.gm_m3_s2))


def drift_times(scenario: Scenario, miss: Miss) -> Array:
    """Nodes of a drift past the epoch, s, shape (n,)."""
    start, spell = scenario.burns.times_s[miss.burn - 1], drift_duration_s(scenario)
    count = int(np.ceil(spell / _step_s(scenario) - 1e-9))
    return np.linspace(start, start + spell, max(count, 1) + 1)


def drift_probability(scenario: Scenario) -> float:
    """Probability with which each drift has to be safe."""
    return scenario.safety.drift_probability or DRIFT_PROBABILITY


def problem_drifts(
    scene: Scene,
    forces: ForceModel,
    partials: Partials | None,
    units: Units,
    losses: Mapping[str, float],
) -> Iterator[Drift]:
    """The drifts of a scenario, nondimensional, with the forces of its planner and partials in SI.

    `losses` are the standard deviations by which flights are less safe than the linear law, by names;
    infinite where that law knows nothing of it, and tangent planes stand for it.
    """
    scenario, own = scene.scenario, forces.in_units(units.length_m, units.time_s)
    moved = partials and partials.in_units(units.length_m, units.time_s)
    for miss in planned_misses(scenario):
        loss = losses.get(miss.name, 0.0)
        by_planes = np.isinf(loss)
        required = quantile(drift_probability(scenario)) + (0.0 if by_planes else loss)
        times = drift_times(scenario, miss)
        flow = GridFlow(own, times[:-1] / units.time_s, np.diff(times) / units.time_s, 1, moved)
        keep_out = [Ball(np.zeros((len(times), 3)), drift_radius_m(scenario) / units.length_m)]
        if scene.companion is not None:
            centre = scene.companion.position(times) / units.length_m
            keep_out.append(Ball(centre, companion_distance_m(scenario) / units.length_m))
        burn = miss.burn - 1 - scenario.burns_flown
        yield Drift(miss.name, burn, miss.share, flow, tuple(keep_out), required, bool(by_planes))


def attitudes_left_s(scene: Scene) -> float:
    """Time after the last burn until a table of attitudes ends, s; infinite without a table."""
    rotation = scene.rotation
    if not isinstance(rotation, TabulatedRotation):
        return np.inf
    return float(rotation.table.tdb_s[-1]) - rotation.epoch_s - scene.scenario.duration_s


def check_miss(scenario: Scenario, number: int | None) -> None:
    """Refuse the number of a missed burn that is not planned.

    Raises:
        InputError: if there is one, and no such burn.
    """
    numbers = range(1 + scenario.burns_flown, 1 + len(scenario.burns.times_s))
    if number is not None and number not in numbers:
        allowed = f"must be a burn that is planned, {numbers[0]} to {numbers[-1]}"
        raise InputError(option("miss"), str(number), allowed)


def check_drifts(scene: Scene) -> None:
    """Refuse drifts that cannot be planned.

    Raises:
        InputError: naming the entry, what was given and what is allowed.
    """
    scenario, safety = scene.scenario, scene.scenario.safety
    given = [
        key for key in ("drift_s", "drift_probability", "drift_radius_m") if getattr(safety, key)
    ]
    if not (safety.missed_burns or safety.cut_short):
        if given:
            entry = f"safety.{given[0]}"
            needs = "has no effect without safety.missed_burns or safety.cut_short"
            raise InputError(entry, exact(getattr(safety, given[0])), needs)
        return
    body = scenario.body.reference_radius_m
    if drift_radius_m(scenario) < body:
        entry = "drift_radius_m" if safety.drift_radius_m else "radius_min_m"
        needs = f"must be at least body.reference_radius_m, {exact(body)} m"
        raise InputError(f"safety.{entry}", f"{exact(drift_radius_m(scenario))} m", needs)
    spell, step = drift_duration_s(scenario), _step_s(scenario)
    if spell > NODES_MAX * step:
        needs = f"must be at most {NODES_MAX * step:.0f} s, {NODES_MAX} nodes a drift"
        raise InputError("safety.drift_s", f"{exact(spell)} s", needs)
    if spell > (left := attitudes_left_s(scene)):
        needs = f"must be at most {np.floor(left):.0f} s, when the table of attitudes ends"
        raise InputError("safety.drift_s", f"{exact(spell)} s", needs)
