"""Sample flights with errors of the initial state and of the burns, in independent blocks."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Literal

import numpy as np

from formulations.arrays import Array, Booleans
from formulations.linearisation.linearisation import Linearisation
from formulations.problem.flyby import FlybyProblem
from scp_recon.jobs.job import generator
from scp_recon.mission.constraints import SAFETY
from scp_recon.mission.mission import Mission
from scp_recon.mission.scene import TruthModel, errors_of_kind, make_grid
from scp_recon.monte_carlo.closed_loop import MEASURED, ClosedLoop, Replan, ReplanLoop, Replans, due
from scp_recon.monte_carlo.limits import allowed
from scp_recon.physics.flow import SHARES, interpolate, runge_kutta
from scp_recon.physics.forces import accelerations
from scp_recon.planning.initial_guess import from_burns
from scp_recon.results.policy import Correction, Policy

ErrorModel = Literal["componentwise", "gates"]
AnyPolicy = Policy | Replans
PolicyKind = Literal["open", "replan", "feedback"]
"""What is commanded: the planned burns, burns planned again before each, or corrected by gains."""
Flow = Callable[[Array, Array, float, float], tuple[Array, Array]]

BLOCK = 1000
"""Flights drawn from one seed: a flight is the same however many others are flown, and where."""

NAVIGATION = 4
"""A stream of its own: measurements leave all other draws unchanged."""

PARAMETERS = 5
"""Stream of the uncertain parameters, for the same reason."""


@dataclass(frozen=True, eq=False)
class FlightLog:
    """Sampled flights.

    Attributes:
        times_s: sampled times, shape (n,).
        states: J2000, m and m/s, after the burns, shape (n, flights, 6).
        burns_m_s: executed burns, shape (flights, m, 3).
        commanded_m_s: commanded burns, of the same shape.
        closest_m: smallest distance from the body's centre at the ends of steps, shape (flights,).
        apart_m: smallest distance from the companion's centre there, infinite without one.
        failed: whether planning again failed, at each of k cut-offs, shape (k, flights); k = 0 where
            nothing is planned again.
        mission: as the flights have it, with their parameters.
    """

    times_s: Array
    states: Array
    burns_m_s: Array
    commanded_m_s: Array
    closest_m: Array
    apart_m: Array
    failed: Booleans
    mission: Mission


def draw_parameters(mission: Mission, seed: int, block: int) -> Array:
    """The draws of the uncertain parameters of a block of flights, shape (BLOCK, p)."""
    return draw(seed, block, mission.uncertain.count, PARAMETERS)


def flown_mission(mission: Mission, seed: int, flights: int) -> Mission:
    """The mission as the first flights of a seed have it, each with its own parameters."""
    blocks = range(-(-flights // BLOCK))
    draws = [draw_parameters(mission, seed, block) for block in blocks]
    return mission.of_flights(np.concatenate(draws)[:flights])


def draw(seed: int, block: int, sources: int, *stream: int) -> Array:
    """The standard normal numbers of a block of flights, shape (BLOCK, sources)."""
    return generator(seed, block, *stream).standard_normal((BLOCK, sources))


@dataclass(frozen=True, eq=False)
class Flyer:
    """Flies planned burns with errors by draws: standard normal numbers, shape (flights, sources).

    The draws are those of the initial state, of the uncertain parameters, of the burns' execution, and
    of the measurements. Each flight has its own parameters in forces, site and companion.

    The initial state is Gaussian about the mission's. A burn is executed with the scenario's errors:
    dv (1 + beta w) by component with w standard normal (Echigo et al., eq. 3), or Gates' model.
    With `errors` = "gates" Gates' model replaces the former by its isotropic counterpart: errors of
    beta in magnitude and of beta rad about each axis across. The forces are those of the plan, or have
    another gravity turning with the body: with "harmonics" the whole field, with "polyhedron" that of a
    homogeneous solid. A policy corrects burns, or plans them again; their errors are those of the
    commanded burn.

    Attributes:
        mission: that is flown.
        burns_m_s: planned, J2000, shape (m, 3).
        policy: that commands others.
        truth: gravity of the flights.
        errors: of the burns; the scenario's if None.
        seed: of all draws.

    Raises:
        InputError: if truth or errors cannot be flown in this scenario.
    """

    mission: Mission
    burns_m_s: Array
    policy: AnyPolicy = ()
    truth: TruthModel = "planner"
    errors: ErrorModel | None = None
    seed: int = 0

    def __post_init__(self) -> None:
        """Refuse inputs that make flights impossible, and another body's gravity."""
        errors_of_kind(self.mission.scenario, self.errors)
        self.mission.scene.gravity_in_words(self.truth)

    def __getstate__(self) -> dict[str, object]:
        """What a copy for another process takes along, with `certain`, which takes long to find."""
        _ = self.certain
        return vars(self)

    @cached_property
    def certain(self) -> bool:
        """Whether flights spread by less than the mean's tolerance all the way, by the linearised flow.

        Corrections, which narrow the spread, are left out. Nothing that flights can show tells one such
        flight from another, so that probabilities are 1 or 0, by the one path that all fly.
        """
        mission = self.mission
        if mission.uncertain.count:  # a site or a pole that is uncertain spreads no path
            return False
        factor = self.linearised(mission.problem.open_loop).factor[:, :3]
        widest = np.linalg.norm(factor, ord=2, axis=(1, 2)).max()
        return bool(widest * mission.units.length_m < allowed(mission, SAFETY))

    def linearised(self, problem: FlybyProblem) -> Linearisation:
        """The mission's problem at the planned burns, with the errors of the flights."""
        mission = self.mission
        errors = errors_of_kind(mission.scenario, self.errors).in_units(mission.units.speed_m_s)
        problem = replace(problem, execution_errors=errors)
        return mission.dynamics.linearise(problem, from_burns(mission, self.burns_m_s))

    @property
    def sources(self) -> int:
        """Number of draws of a flight besides those of its measurements."""
        model = errors_of_kind(self.mission.scenario, self.errors)
        initial = self.mission.initial_factor.shape[1] + self.mission.uncertain.count
        return initial + model.draws(len(self.burns_m_s))

    def draws(self, block: int) -> Array:
        """The draws of a block of flights, shape (BLOCK, sources)."""
        p, initial = self.mission.uncertain.count, self.mission.initial_factor.shape[1]
        draws = draw(self.seed, block, self.sources - p)
        if p:
            own = draw_parameters(self.mission, self.seed, block)
            draws = np.hstack([draws[:, :initial], own, draws[:, initial:]])
        measured = draw(self.seed, block, MEASURED * len(self.policy), NAVIGATION)
        return np.hstack([draws, measured]) if self.policy else draws

    def blocks_of_draws(self, samples: int) -> Iterator[Array]:
        """The draws of the first flights, block by block."""
        for first in range(0, samples, BLOCK):
            yield self.draws(first // BLOCK)[: samples - first]

    def first_draws(self, samples: int) -> Array:
        """The draws of the first flights, shape (samples, sources)."""
        return np.concatenate([*self.blocks_of_draws(samples)])

    def fly_blocks(self, times_s: Array, samples: int) -> Iterator[FlightLog]:
        """Fly the first flights, block by block: see `fly`."""
        for draws in self.blocks_of_draws(samples):
            yield self.fly(times_s, draws)

    def first_positions(self, times_s: Array, samples: int) -> Array:
        """Positions of the first flights, J2000, m, shape (times, samples, 3)."""
        blocks = self.fly_blocks(times_s, samples)
        return np.concatenate([flown.states[..., :3] for flown in blocks], axis=1)

    def fly_block(self, times_s: Array, block: int, *, flights: int = BLOCK) -> FlightLog:
        """Fly the first `flights` of a block of draws, at most `BLOCK`: see `fly`."""
        return self.fly(times_s, self.draws(block)[:flights])

    def fly(self, times_s: Array, draws: Array, until_s: float = np.inf) -> FlightLog:
        """Fly draws, shape (flights, sources).

        Integration steps depend on the burns' times alone; states at the ascending `times_s` are
        interpolated. Nothing is flown after `until_s`.
        """
        mission, burns_m_s, policy = self.mission, self.burns_m_s, self.policy
        initial, flights = mission.initial_factor.shape[1], len(draws)
        state = mission.initial_state + draws[:, :initial] @ mission.initial_factor.T
        model = errors_of_kind(mission.scenario, self.errors)
        p = mission.uncertain.count
        known, draws = np.hsplit(draws[:, initial:], [p])
        draws, measured = np.hsplit(draws, [model.draws(len(burns_m_s))])
        as_flown = mission.of_flights(known)
        executed = model.execute(burns_m_s, draws)
        commanded = np.tile(burns_m_s, (flights, 1, 1))
        loop = start_loop(mission, burns_m_s, policy, measured)
        fly = flow_of(as_flown, self.truth)
        firing = mission.scenario.burn_times_s
        burn_at = dict(zip(firing, range(len(burns_m_s)), strict=True))
        stops = make_grid((mission.scenario.start_s, *firing), mission.flight_step_s)
        stops = stops[stops <= until_s]
        after = np.searchsorted(times_s, stops, side="right")
        # Components first, so that an operation runs along the flights.
        states = np.empty((len(times_s), 6, flights))
        r, v = (np.ascontiguousarray(half.T) for half in (state[:, :3], state[:, 3:]))
        companion = as_flown.scene.companion
        closest2, apart2 = np.full((2, flights), np.inf)
        for _ in due(policy, -np.inf, stops[0]):
            loop.measure(np.concatenate([r, v]))
        for k, stop in enumerate(stops.tolist()):
            if stop in burn_at:
                burn = burn_at[stop]
                correction = loop.correction(burn)
                if correction is not None:
                    commanded[:, burn] += correction
                    own = model.draws_of_burn(draws, burn)
                    executed[:, burn] = model.execute(commanded[:, burn : burn + 1], own)[:, 0]
                v = v + executed[:, burn].T
            states[times_s == stop] = np.concatenate([r, v])
            closest2 = np.minimum(closest2, np.einsum("in,in->n", r, r))
            if companion is not None:
                apart = r - np.atleast_2d(companion.position(stop)).T
                apart2 = np.minimum(apart2, np.einsum("in,in->n", apart, apart))
            if stop < stops[-1]:
                duration = stops[k + 1] - stop
                end = fly(r, v, stop, duration)
                for row in range(after[k], np.searchsorted(times_s, stops[k + 1])):
                    share = (times_s[row] - stop) / duration
                    states[row, :3], states[row, 3:] = interpolate((r, v), end, duration, share)
                for time in due(policy, stop, stops[k + 1]):
                    share = (time - stop) / duration
                    loop.measure(np.concatenate(interpolate((r, v), end, duration, share)))
                r, v = end
        failed = np.array(loop.failed, dtype=np.bool_).reshape(-1, flights)
        states = np.moveaxis(states, 1, 2)
        return FlightLog(
            times_s,
            states,
            executed,
            commanded,
            np.sqrt(closest2),
            np.sqrt(apart2),
            failed,
            as_flown,
        )


def policy_kind(policy: AnyPolicy) -> PolicyKind:
    """Name of a policy."""
    if not policy:
        return "open"
    return "replan" if isinstance(policy[0], Replan) else "feedback"


def start_loop(
    mission: Mission, burns_m_s: Array, policy: AnyPolicy, draws: Array
) -> ClosedLoop | ReplanLoop:
    """Make the loop that commands the burns, from the draws of the measurements."""
    again = tuple(one for one in policy if isinstance(one, Replan))
    if again:
        return ReplanLoop(mission, burns_m_s, again, draws)
    return ClosedLoop(mission, burns_m_s, corrections_of(policy), draws)


def corrections_of(policy: AnyPolicy) -> Policy:
    """The burns that a policy corrects by gains."""
    return tuple(one for one in policy if isinstance(one, Correction))


def flow_of(mission: Mission, truth: TruthModel) -> Flow:
    """Flow of positions and velocities (3, flights) from a time over a duration."""
    forces, each = mission.scene.forces(truth), mission.deviation is not None

    def flow(r: Array, v: Array, start: float, duration: float) -> tuple[Array, Array]:
        times = [start + share * duration for share in SHARES]
        moments = (forces.moment(np.full(r.shape[1], t) if each else t) for t in times)
        _, *end = runge_kutta(
            r, v, duration, lambda at, known: accelerations(at, forces, known), moments
        )
        return end[0], end[1]

    return flow
