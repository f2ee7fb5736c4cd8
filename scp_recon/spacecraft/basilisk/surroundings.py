"""The asteroid and the Sun, as Basilisk's messages."""

from __future__ import annotations

import numpy as np
from Basilisk.architecture import messaging, sysModel
from Basilisk.utilities import macros

from scp_recon.mission.mission import Mission
from scp_recon.spacecraft.estimator import cross_matrix

SURROUNDINGS_S = 10.0
"""How often the asteroid's attitude is renewed; Basilisk extrapolates it to 8e-6 rad in between."""


class Surroundings(sysModel.SysModel):
    """Attitude of the asteroid, position of the Sun, and the asteroid's shadow as messages.

    The shadow is a cylinder of the reference radius.
    """

    def __init__(self, mission: Mission) -> None:
        super().__init__()
        self.mission = mission
        self.asteroid = messaging.SpicePlanetStateMsg()
        self.sun = messaging.SpicePlanetStateMsg()
        self.shadow = messaging.EclipseMsg()
        self.states = messaging.SCStatesMsgReader()

    def Reset(self, now: int) -> None:  # noqa: N802, D102 -- as Basilisk names it
        self.UpdateState(now)

    def UpdateState(self, now: int) -> None:  # noqa: N802, D102 -- as Basilisk names it
        time = now * macros.NANO2SEC
        rotation = self.mission.rotation
        to_body = rotation.body_to_j2000(time).T
        rate = rotation.rate + rotation.acceleration * time
        asteroid = messaging.SpicePlanetStateMsgPayload()
        asteroid.J20002Pfix = to_body.tolist()
        asteroid.J20002Pfix_dot = (
            -rate * cross_matrix(np.array([0.0, 0.0, 1.0])) @ to_body
        ).tolist()
        self.asteroid.write(asteroid, now)
        direction = self.mission.sun_direction(time)
        distance = np.linalg.norm(self.mission.scenario.sun.body_position_km) * 1e3
        sun = messaging.SpicePlanetStateMsgPayload()
        sun.PositionVector = (distance * direction).tolist()
        self.sun.write(sun, now)
        position = np.array(self.states().r_BN_N)
        along = float(position @ direction)
        across = np.linalg.norm(position - along * direction)
        dark = along < 0.0 and across < self.mission.scenario.body.reference_radius_m
        self.shadow.write(messaging.EclipseMsgPayload(illuminationFactor=float(not dark)), now)
