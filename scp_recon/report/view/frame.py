"""The axes of the 3-D view and the box that it shows, from the plans in it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from scp_recon.physics.frames import sun_north_to_j2000
from scp_recon.report.content.flown import Flown
from scp_recon.report.content.ground import GroundTrack
from scp_recon.report.content.subject import Subject

Array = npt.NDArray[np.float64]

ARROW = 0.13
"""Length of the largest burn's arrow, over the longest edge of what the paths fill."""
ROOM = 0.04
"""Around what is drawn, over its longest edge."""


@dataclass(frozen=True, eq=False)
class Shown:
    """A plan with all that is drawn of it."""

    subject: Subject
    flown: Flown
    ground: GroundTrack


@dataclass(frozen=True, eq=False)
class Frame:
    """From J2000 to the axes of the view.

    Attributes:
        to_j2000: shape (3, 3).
        low_m: least of each coordinate that is in the box, shape (3,).
        high_m: largest of each.
        arrow_m: length of the largest burn's arrow.
    """

    to_j2000: Array
    low_m: Array
    high_m: Array
    arrow_m: float

    def seen(self, vectors: Array) -> Array:
        """Vectors (..., 3) in J2000 in the view's axes."""
        return vectors @ self.to_j2000


def frame_of(plans: Sequence[Shown]) -> Frame:
    """Of the first plan, with room for the mean paths of all, burns, and the safety radius.

    The box ends at whole metres, as it is written: what stands on its edge is in it.
    """
    mission = plans[0].subject.mission
    axes = sun_north_to_j2000(mission.sun_direction(0.0), mission.rotation.pole)
    paths = np.vstack([one.subject.positions(one.subject.fine_s) @ axes for one in plans])
    safety = mission.scenario.safety.radius_min_m
    low, high = np.minimum(paths.min(axis=0), -safety), np.maximum(paths.max(axis=0), safety)
    edge = float((high - low).max())
    bare = Frame(axes, low, high, ARROW * edge)
    tips = np.vstack([arrows_of(bare, one.subject)[1] for one in plans])
    low, high = np.minimum(low, tips.min(axis=0)), np.maximum(high, tips.max(axis=0))
    low, high = np.floor(low - ROOM * edge), np.ceil(high + ROOM * edge)
    return replace(bare, low_m=low, high_m=high)


def arrows_of(frame: Frame, subject: Subject) -> tuple[Array, Array]:
    """Where the burns' arrows start and end, shape (m, 3) each."""
    solution = subject.solution
    sizes = np.linalg.norm(solution.burns_m_s, axis=1)
    scale = frame.arrow_m / max(float(sizes.max()), 1e-12)
    starts = frame.seen(subject.positions(np.array([burn.t_s for burn in solution.burns])))
    return starts, starts + scale * frame.seen(solution.burns_m_s)
