"""One flight under models of any fidelity: where it ends, and its path."""

from __future__ import annotations

import itertools
from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol

import numpy as np
import numpy.typing as npt
from scipy.integrate import solve_ivp

from scp_recon.mission.mission import Mission

Array = npt.NDArray[np.float64]

RELATIVE_TOLERANCE, ABSOLUTE_TOLERANCE = 1e-11, 1e-9
"""Of the integrator; together they are worth less than 0.1 mm at the end of the flight."""


class Gravity(Protocol):
    """A gravity field in the body's own frame."""

    def acceleration(self, x: Array, y: Array, z: Array) -> tuple[Array, Array, Array]:
        """Components of the acceleration, m/s^2, of the position's, m."""
        ...


@dataclass(frozen=True)
class Firing:
    """How a burn is modelled.

    Attributes:
        finite: whether the thrust lasts, from the firing time on, or is an impulse.
        late: of an impulse, by what part of the firing's length it follows the firing time.
    """

    finite: bool
    late: float = 0.0


@dataclass(frozen=True)
class Model:
    """A model of the flight.

    Attributes:
        gravity: turning with the body.
        srp: acceleration by solar radiation pressure in J2000, m/s^2, of the time in s.
        firing: of the burns.
    """

    gravity: Gravity
    srp: Callable[[float], Array]
    firing: Firing


def fly(
    mission: Mission,
    burns_m_s: Array,
    model: Model,
    times_s: Array,
    *,
    thrust_acceleration_m_s2: float,
    breaks_s: tuple[float, ...] = (),
) -> Array:
    """States before any burn at the same time, J2000, m and m/s, shape (n, 6).

    Args:
        mission: initial state, rotation and firing times.
        burns_m_s: planned burns, shape (m, 3); none of them sets a flight off course if it is zero.
        model: what is flown.
        times_s: ascending times to look at, from 0 on.
        thrust_acceleration_m_s2: while firing; it is constant, the propellant being a ten-thousandth.
        breaks_s: times at which `model.srp` may jump.
    """
    lengths = np.linalg.norm(burns_m_s, axis=1) / thrust_acceleration_m_s2
    starts = np.array(mission.scenario.burns.times_s)
    impulses: dict[float, Array] = {}
    thrusts: list[tuple[float, float, Array]] = []
    for start, length, burn in zip(starts.tolist(), lengths.tolist(), burns_m_s, strict=True):
        if model.firing.finite:
            thrusts.append((start, start + length, burn / length if length else burn))
        else:
            impulses[start + model.firing.late * length] = burn
    end = float(times_s[-1])
    edges = {0.0, end, *impulses, *breaks_s}
    edges |= {edge for start, stop, _ in thrusts for edge in (start, stop)}
    stops = sorted(edge for edge in edges if edge <= end)

    state = mission.initial_state.copy()
    seen = [state[None].copy()] if times_s[0] == 0.0 else []
    for before, after in itertools.pairwise(stops):
        state[3:] += impulses.get(before, np.zeros(3))
        middle = 0.5 * (before + after)
        thrust = sum((a for start, stop, a in thrusts if start < middle < stop), np.zeros(3))
        looks = times_s[(times_s > before) & (times_s <= after)]
        states = _arc(mission, model, state, np.union1d(looks, after), before, thrust)
        seen.append(states[: len(looks)])
        state = states[-1].copy()
    return np.concatenate(seen)


def _arc(
    mission: Mission, model: Model, state: Array, looks: Array, start: float, thrust: Array
) -> Array:
    """States at some times of an arc in which no force jumps, its end the last of them."""
    stop = float(looks[-1])
    inside = np.nextafter(stop, start)  # an arc belongs to what holds before its end

    def rate(time: float, y: Array) -> Array:
        to_j2000 = mission.rotation.body_to_j2000(time)
        gravity = np.array(model.gravity.acceleration(*(to_j2000.T @ y[:3])))
        return np.concatenate([y[3:], to_j2000 @ gravity + model.srp(min(time, inside)) + thrust])

    found = solve_ivp(
        rate,
        (start, stop),
        state,
        method="DOP853",
        t_eval=looks,
        rtol=RELATIVE_TOLERANCE,
        atol=ABSOLUTE_TOLERANCE,
    )
    return found.y.T
