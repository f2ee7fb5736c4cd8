"""Set up the rest of a flight under way as a mission of its own, from the delivered state.

Its scenario is that of the plan in flight with a table `in_flight`. All functions that plan, verify
or fly a mission therefore serve it as well. Planning begins at the planned path and runs all
stages, P3 first. Facets chosen on the planned path would cost 15 % more delta-v from 3000 s on,
because that path was planned for a larger spread than that of a newly determined state.

Burns that are left may move, within the rules, to where the rest is cheapest.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from numbers import Real
from typing import Any

import numpy as np
import numpy.typing as npt
from scipy.special import chdtrc, chdtri  # of chi-squared; scipy.stats takes half a second

from formulations.arrays import Array
from formulations.problem.flyby import Iterate
from scp_recon.display import digits, exact
from scp_recon.errors import InputError, number_between, one_of, option, shortened, whole_number
from scp_recon.mission.checks import later_end
from scp_recon.mission.mission import Mission
from scp_recon.passes.space import Pass, Space
from scp_recon.passes.timing import Effort, Timing
from scp_recon.physics.flow import propagate
from scp_recon.planning.initial_guess import nondimensional
from scp_recon.replanning.flown import FlownPlan, Prediction, predict
from scp_recon.scenario.fields import ScenarioWarning
from scp_recon.scenario.load import override
from scp_recon.scenario.schema import Scenario

UNITS_RATIO_MAX = 30.0
"""Ratio of distances or speeds: kilometres are 1000 metres; no flight errs by the root of that."""
UNLIKELY = 1e-4
"""Probability of a state as far from the prediction, below which it hardly is that of this flight."""
SURE_SIGMAS = 5.0
"""Multiple of a burn's errors beyond which a measurement is unlikely to be of the planned burn."""
LEAST_SPREAD = 1e-6
"""Spread in units of length and speed that is added to each: a millimetre is no contradiction."""

FRAMES = ("j2000", "sun_north")
MEASURED = option("measured_burns")
WORDS = {
    (6,): "six numbers, m and m/s",
    (3,): "three numbers, m/s",
    (6, 6): "six rows of six numbers",
}


def numbers(entry: str, given: npt.ArrayLike, shape: tuple[int, ...], words: str = "") -> Array:
    """An array of finite numbers.

    Raises:
        InputError: if it is not numeric, not finite, or of another shape; `words` say what is allowed.
    """
    try:
        array = np.asarray(given, dtype=float)
    except (TypeError, ValueError):
        array = np.full(0, np.nan)
    if array.shape != shape or not np.isfinite(array).all():
        found = " ".join(shortened(given).replace("\\n", " ").split())
        raise InputError(entry, found, f"must be {words or WORDS[shape]}, all finite")
    return array


def _time(entry: str, given: object) -> float:
    """Check that a time is a finite number of any type."""
    if isinstance(given, Real) and not isinstance(given, bool):
        with suppress(OverflowError):
            if np.isfinite(time := float(given)):
                return time
    raise InputError(entry, shortened(given), "must be a time past the epoch, s")


@dataclass(frozen=True, eq=False)
class Delivery:
    """A state in flight, as it was delivered.

    Attributes:
        at_s: time past the plan's epoch, s; burns at or before it are flown.
        state: state after these burns, m and m/s, body-centred, shape (6,).
        frame: axes of state and measured burns, at the epoch.
        covariance: m and m/s, shape (6, 6); the scenario's initial one if there is none.
        covariance_frame: its axes.
        measured: flown burns as telemetry saw them, m/s, shape (3,), by their number in the flight
            from 1.
    """

    at_s: float
    state: Array
    frame: str = "j2000"
    covariance: Array | None = None
    covariance_frame: str = "j2000"
    measured: Mapping[int, Array] = field(default_factory=dict)

    @classmethod
    def of(
        cls,
        at_s: float,
        state: npt.ArrayLike,
        *,
        frame: str = "j2000",
        covariance: npt.ArrayLike | None = None,
        covariance_frame: str | None = None,
        measured: Mapping[int, npt.ArrayLike] | None = None,
    ) -> Delivery:
        """Make a delivery from a user's values, each of them checked; see the attributes.

        Raises:
            InputError: naming the entry, what was given and what is allowed.
        """
        burns = {} if measured is None else measured
        if not isinstance(burns, Mapping):
            raise InputError(MEASURED, shortened(burns), "must be a table of burns by number")
        if covariance_frame is not None and covariance is None:
            raise InputError(option("covariance_frame"), covariance_frame, "goes with a covariance")
        axes = frame if covariance_frame is None else covariance_frame
        matrix = None if covariance is None else numbers(option("covariance"), covariance, (6, 6))
        return cls(
            at_s=_time(option("at_s"), at_s),
            state=numbers(option("state"), state, (6,)),
            frame=one_of(option("frame"), frame, FRAMES),
            covariance=matrix,
            covariance_frame=one_of(option("covariance_frame"), axes, (*FRAMES, "rtn")),
            measured={
                whole_number(MEASURED, n, 1, 64): numbers(MEASURED, burn, (3,))
                for n, burn in burns.items()
            },
        )

    def burns_flown(self, scenario: Scenario, planned: Array) -> list[list[float]]:
        """Every burn of the flight so far, m/s: measured, or as planned, of a plan's burns (m, 3).

        Raises:
            InputError: if a burn was measured that has not been flown.
        """
        before = [] if scenario.in_flight is None else list(scenario.in_flight.flown_m_s)
        ahead = zip(scenario.burn_times_s, planned.tolist(), strict=True)
        flown = [*before, *(burn for time, burn in ahead if time <= self.at_s)]
        for number, burn in self.measured.items():
            if number > len(flown):
                allowed = f"must be one of those flown by {self.at_s:g} s, 1 to {len(flown)}"
                raise InputError(MEASURED, f"burn {number}", allowed)
            flown[number - 1] = burn.tolist()
        return [list(burn) for burn in flown]

    def strange_burns(
        self, scenario: Scenario, planned: Array, kicks: Array
    ) -> Iterator[ScenarioWarning]:
        """Measured burns that are far from those of the plan that is flown, shape (m, 3), m/s.

        `kicks` are the factors of their covariances, corrections included, shape (m, 3, c).

        Raises:
            InputError: if one is no burn of this flight in metres per second.
        """
        first = scenario.burns_flown + 1
        for number, burn in sorted(self.measured.items()):
            if not 0 <= number - first < len(planned):
                continue
            expected = planned[number - first]
            sigma = float(np.linalg.norm(kicks[number - first]))
            off = float(np.linalg.norm(burn - expected))
            size, planned_size = float(np.linalg.norm(burn)), float(np.linalg.norm(expected))
            if size > max(UNITS_RATIO_MAX * planned_size, scenario.burns.dv_max_m_s):
                raise InputError(
                    MEASURED,
                    f"burn {number} of {digits(size, 4)}",
                    f"must be in m/s: the plan has {digits(planned_size, 4)} m/s then",
                )
            if off > SURE_SIGMAS * sigma and off > 0.0:
                yield ScenarioWarning.of(
                    "measured_burns",
                    f"burn {number} {digits(1e3 * off, 3)} mm/s from the one planned",
                    f"expected at most {1e3 * SURE_SIGMAS * sigma:.3g} mm/s, {SURE_SIGMAS:g} sigma of "
                    "its errors: check unit and frame",
                )

    def strange_state(
        self, state: Array, factor: Array, predicted: Prediction, units: Array
    ) -> Iterator[ScenarioWarning]:
        """Compare the state with the prediction of the plan in flight for the same time.

        The state (6,), m and m/s, and the factor (6, 6) of its covariance are in J2000; units (6,) are
        those of length and speed.

        Raises:
            InputError: if it is not in metres and seconds.
        """
        spread = (factor @ factor.T + predicted.covariance) / np.outer(units, units)
        spread += LEAST_SPREAD**2 * np.eye(6)
        off = (state - predicted.state) / units
        for part, noun, unit_name in (
            (slice(3), "position", "m"),
            (slice(3, 6), "velocity", "m/s"),
        ):
            given, expected = (float(np.linalg.norm(s[part])) for s in (state, predicted.state))
            low, high = sorted((given, expected))
            sigma = float(np.sqrt(np.trace(spread[part, part])))
            if high > UNITS_RATIO_MAX * low and np.linalg.norm(off[part]) > SURE_SIGMAS * sigma:
                raise InputError(
                    option("state"),
                    f"a {noun} of {digits(given, 4)}",
                    f"must be in {unit_name}: the plan has {digits(expected, 4)} {unit_name} then",
                )
        distance2 = float(off @ np.linalg.solve(spread, off))
        if chdtrc(6, distance2) < UNLIKELY:
            position, velocity = np.linalg.norm((state - predicted.state).reshape(2, 3), axis=1)
            yield ScenarioWarning.of(
                "state",
                f"{digits(position, 4)} m and {digits(1e3 * velocity, 3)} mm/s from what the plan "
                f"predicts at {self.at_s:g} s",
                f"{np.sqrt(distance2):.1f} sigma, expected at most {np.sqrt(chdtri(6, UNLIKELY)):.1f}: "
                "check units, frame and the burns flown",
            )


KEPT = ("epoch", "in_flight")
"""Tables that no override may change: they say what the delivered state is of."""


def mission_left(flown: FlownPlan, delivery: Delivery, overrides: Sequence[str] = ()) -> Mission:
    """Make the rest of a mission, with the warnings of the flight so far.

    Each override is `section.entry=value`, for the rest of the flight.

    Raises:
        InputError: naming the entry, what was given and what is allowed.
    """
    before = flown.mission.scenario
    axes = flown.mission.scene.axes(delivery.frame)
    in_j2000 = {number: axes @ burn for number, burn in delivery.measured.items()}
    delivery = replace(delivery, measured=in_j2000)
    at = delivery.at_s
    if at < before.start_s:
        raise InputError(
            option("at_s"),
            f"{exact(at)} s",
            f"must not be before {exact(before.start_s)} s past its epoch, where the plan begins",
        )
    burns = delivery.burns_flown(before, flown.burns_m_s)
    known = flown.known_at(at) if delivery.covariance is None else None
    if known is not None:
        delivery = replace(delivery, covariance=known, covariance_frame="j2000")
    data: dict[str, Any] = before.model_dump(mode="json", exclude_none=True)
    data["in_flight"] = {
        "at_s": at,
        "frame": delivery.frame,
        "position_m": delivery.state[:3].tolist(),
        "velocity_m_s": delivery.state[3:].tolist(),
        "covariance_frame": delivery.covariance_frame,
        "flown_m_s": burns,
    }
    if delivery.covariance is not None:
        data["in_flight"]["covariance"] = delivery.covariance.tolist()
    try:
        scenario = _changed(Scenario.validated(data), overrides)
        mission = Mission.from_scenario(scenario, known=flown.mission)
    except InputError as error:
        if (part := _delivered(error.entry)) is None:
            raise
        raise InputError(option(part), error.given, error.allowed) from None
    kept = before.burns.times_s[: len(burns)]
    if scenario.burns.times_s[: len(burns)] != kept or scenario.burns_flown != len(burns):
        raise InputError(
            "burns.times_s", "other times of burns that are flown", f"must keep {kept}"
        )
    predicted = predict(flown, at, delivery.measured)
    renamed = [
        w.model_copy(update={"entry": _delivered(w.entry) or w.entry})
        for w in mission.warnings
        if w not in flown.mission.warnings
    ]
    warnings = (
        *flown.mission.warnings,
        *later_end(before, scenario),
        *renamed,
        *flown.solution.warnings,
        *flown.strange(),
        *delivery.strange_burns(before, flown.burns_m_s, flown.kicks),
        *delivery.strange_state(
            mission.initial_state, mission.initial_factor, predicted, mission.units.state
        ),
    )
    return replace(mission, warnings=tuple(dict.fromkeys(warnings)))


def with_goal(
    flown: FlownPlan, goal: str, arrive_by: float | None, overrides: Sequence[str] = ()
) -> list[str]:
    """Overrides for the purpose of the rest of a flight, and the time of its last burn, s; and more.

    Raises:
        InputError: if the goal is unknown, or the time is not after the other burns, or given twice.
    """
    one_of(option("goal"), goal, ("observe", "return"))
    found = ["observation.required=false"] if goal == "return" else []
    if arrive_by is not None:
        *times, _ = flown.mission.scenario.burns.times_s
        arrive_by = number_between(option("arrive_by"), arrive_by, 0.0, 1e7, "s")
        if not arrive_by > times[-1]:
            allowed = f"must be after the burn before, {exact(times[-1])} s"
            raise InputError(option("arrive_by"), f"{exact(arrive_by)} s", allowed)
        if twice := [one for one in overrides if one.startswith("burns.times_s=")]:
            allowed = "must be left out beside burns.times_s, whose last burn fixes the same time"
            raise InputError(option("arrive_by"), f"{exact(arrive_by)} s and {twice[-1]}", allowed)
        found.append(f"burns.times_s={[*times, arrive_by]}")
    return [*found, *overrides]


def _changed(scenario: Scenario, overrides: Sequence[str]) -> Scenario:
    changed = override(scenario, overrides)
    for table in KEPT:
        if getattr(changed, table) != getattr(scenario, table):
            raise InputError(
                option("overrides"),
                f"another {table}",
                "must not change: it describes the flight so far",
            )
    return changed


def _delivered(entry: str) -> str | None:
    """The part of a delivery that an entry of the table `in_flight` comes from; None for others."""
    table, _, key = entry.partition(".")
    key = key.partition(".")[0]
    called = {"position_m": "state", "velocity_m_s": "state", "flown_m_s": "measured_burns"}
    return called.get(key, key) if table == "in_flight" else None


def path_planned(flown: FlownPlan, mission: Mission) -> Iterate:
    """The planned path at the nodes of the rest of the flight.

    As many burns as are left in the plan are those of the plan, in order. Where burns were added or
    left out, each is the plan's of the same time, or begins as zero.
    """
    scenario = flown.mission.scenario
    left = zip(scenario.burn_times_s, flown.burns_m_s, strict=True)
    ahead = {time: burn for time, burn in left if time > mission.scenario.start_s}
    wanted = mission.scenario.burn_times_s
    times = [*ahead] if len(ahead) == len(wanted) else wanted
    burns = np.array([ahead.get(time, np.zeros(3)) for time in times])
    last = np.searchsorted(flown.times_s, mission.times_s, side="right") - 1
    begin = flown.times_s[last]
    since, steps = mission.times_s - begin, mission.arc_substeps
    states = propagate(flown.states[last], since, mission.forces, steps, begin)
    return nondimensional(mission, burns, states)


EFFORT = Effort(rounds=6, worth=1e-3, iterations=40)
DIGITS = 1
"""Times are given to tenths of a second."""


@dataclass(frozen=True)
class Rest(Space):
    """The rest of a flight with its burns at other times; those of burns flown stay."""

    @property
    def has_home(self) -> bool:
        """A state in flight is no phase, and so the arrival's is given too."""
        return False

    def mission_of(self, one: Pass) -> Mission:
        """The mission with other times of its burns, which keep the rules."""
        return self.mission.changed({"burns.times_s": one.times_s})


def with_free_times(flown: FlownPlan, mission: Mission) -> Mission:
    """The rest of a flight with the times at which it is cheapest; the last burn stays.

    The rest is that of `mission_left`. Cut-offs of corrected burns move along. Where no plan is found,
    times stay.

    Raises:
        InputError: if no burn is left that may move.
    """
    scenario = mission.scenario
    times, done = scenario.burns.times_s, scenario.burns_flown
    if len(times) - done < 2:
        left = f"only burn {len(times)} at {times[-1]:g} s left, whose time is the arrival's"
        raise InputError(option("free_times"), left, "needs another burn that is left")
    earliest = scenario.start_s + scenario.navigation.lead_s
    inner = [(earliest, times[-1])] * (len(times) - done - 1)
    spans = [*((time, time) for time in times[:done]), *inner, (times[-1],) * 2]
    state = mission.initial_state
    space = Rest(
        mission,
        lambda _: state,
        mission.schedule.window_s,
        ((0.0, 0.0), (1.0, 1.0)),
        tuple((low, high) for low, high in spans),
    )
    certain = flown.solution.problem == "P3"
    burns = path_planned(flown, mission).burns * mission.units.speed_m_s
    timing = Timing(space, 0, certain)
    best = timing.descend(Pass((0.0, 1.0), times), burns, lambda _: None, EFFORT)
    if not best.converged:
        return mission
    rounded = tuple(np.round(best.at.times_s[done:-1], DIGITS).tolist())
    found = space.mission_of(replace(best.at, times_s=(*times[:done], *rounded, times[-1])))
    return replace(found, warnings=mission.warnings)
