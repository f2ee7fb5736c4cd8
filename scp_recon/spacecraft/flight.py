"""What is known of a simulated flight when it is over."""

from __future__ import annotations

from dataclasses import dataclass
from enum import IntEnum

import numpy as np
import numpy.typing as npt
from scipy.spatial.transform import Rotation

from scp_recon.spacecraft.guidance import FlightPlan

Array = npt.NDArray[np.float64]


class Actuators(IntEnum):
    """What controls the attitude."""

    THRUSTERS = 1
    WHEELS = 2
    BOTH = 3


@dataclass(frozen=True)
class Flight:
    """A simulated flight, sampled once in a control period.

    Attributes:
        plan: what was commanded.
        times_s: shape (n,).
        states: position and velocity, m and m/s, J2000, shape (n, 6).
        attitudes, commands, estimates: from the body to J2000.
        rates_rad_s: of the body, in its frame, shape (n, 3).
        in_use: which actuators control the attitude, shape (n,), of `Actuators`.
        wheel_speeds_rad_s: shape (n, wheels).
        micro_on_s: on-time of each micro-thruster in the period, shape (n, thrusters).
        panels_w: generation, shape (n, panels).
        consumed_w, lost_w, unused_w, short_w: balance of the bus, shape (n,).
        stored_wh: charge of each battery, shape (n, batteries).
        burns_m_s: executed, J2000, shape (m, 3).
        dumps: how often the wheels' momentum was dumped.
        terminal_state: at the planned end, with the last burn as an impulse, shape (6,).
    """

    plan: FlightPlan
    times_s: Array
    states: Array
    attitudes: Rotation
    commands: Rotation
    estimates: Rotation
    rates_rad_s: Array
    in_use: npt.NDArray[np.int8]
    wheel_speeds_rad_s: Array
    micro_on_s: Array
    panels_w: Array
    consumed_w: Array
    lost_w: Array
    unused_w: Array
    short_w: Array
    stored_wh: Array
    burns_m_s: Array
    dumps: int
    terminal_state: Array
