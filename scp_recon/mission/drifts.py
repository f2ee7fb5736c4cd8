"""Drifts of a mission: free flights after a burn that does not happen, or that is cut short.

Drift safety: L. S. Breger and J. P. How, "Safe trajectories for autonomous rendezvous of spacecraft",
Journal of Guidance, Control, and Dynamics 31 (2008) 1478. A drift is a scenario, not a chance: each one
keeps its distance with the required probability.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass

import numpy as np

from formulations.arrays import Array
from formulations.problem.facets import quantile
from formulations.problem.flyby import Drift
from formulations.problem.regions import Ball
from scp_recon.display import exact
from scp_recon.errors import InputError, option
from scp_recon.mission.constraints import companion_distance_m
from scp_recon.mission.scene import NODES_MAX, Scene, Units
from scp_recon.physics.flow import GridFlow
from scp_recon.physics.forces import ForceModel, Partials
from scp_recon.physics.frames import TabulatedRotation
from scp_recon.scenario.schema import DRIFT_PROBABILITY, DRIFT_S, Scenario

STEP_S = 120.0
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


def duration_s(scenario: Scenario) -> float:
    """Time for which a drift must be safe, s."""
    return scenario.safety.drift_s or DRIFT_S


def radius_m(scenario: Scenario) -> float:
    """Least distance of a drift from the body's centre, m."""
    return scenario.safety.drift_radius_m or scenario.safety.radius_min_m


def planned(scenario: Scenario) -> tuple[Miss, ...]:
    """Misses that a plan must survive: of all burns left but the first of the flight."""
    safety, flown = scenario.safety, scenario.burns_flown
    numbers = range(max(2, 1 + flown), 1 + len(scenario.burns.times_s))
    shares = (*((0.0,) if safety.missed_burns else ()), *(CUTS if safety.cut_short else ()))
    return tuple(Miss(number, share) for number in numbers for share in shares)


def _step_s(scenario: Scenario) -> float:
    """Longest arc of a drift, s."""
    return float(NODE_SHARE * np.sqrt(radius_m(scenario) ** 3 / scenario.body.gm_m3_s2))


def drift_times(scenario: Scenario, miss: Miss) -> Array:
    """Nodes of a drift past the epoch, s, shape (n,)."""
    start, spell = scenario.burns.times_s[miss.burn - 1], duration_s(scenario)
    count = int(np.ceil(spell / _step_s(scenario) - 1e-9))
    return np.linspace(start, start + spell, max(count, 1) + 1)


def required_probability(scenario: Scenario) -> float:
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
    for miss in planned(scenario):
        loss = losses.get(miss.name, 0.0)
        by_planes = np.isinf(loss)
        required = quantile(required_probability(scenario)) + (0.0 if by_planes else loss)
        times = drift_times(scenario, miss)
        flow = GridFlow(own, times[:-1] / units.time_s, np.diff(times) / units.time_s, 1, moved)
        keep_out = [Ball(np.zeros((len(times), 3)), radius_m(scenario) / units.length_m)]
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
    if radius_m(scenario) < body:
        entry = "drift_radius_m" if safety.drift_radius_m else "radius_min_m"
        needs = f"must be at least body.reference_radius_m, {exact(body)} m"
        raise InputError(f"safety.{entry}", f"{exact(radius_m(scenario))} m", needs)
    spell, step = duration_s(scenario), _step_s(scenario)
    if spell > NODES_MAX * step:
        needs = f"must be at most {NODES_MAX * step:.0f} s, {NODES_MAX} nodes a drift"
        raise InputError("safety.drift_s", f"{exact(spell)} s", needs)
    if spell > (left := attitudes_left_s(scene)):
        needs = f"must be at most {np.floor(left):.0f} s, when the table of attitudes ends"
        raise InputError("safety.drift_s", f"{exact(spell)} s", needs)
