"""What a design may choose: two phases on the ring and the times of all burns, within their spans."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
import numpy.typing as npt

from scp_recon.mission.grid import make_grid
from scp_recon.mission.legal_burns import burns_before
from scp_recon.mission.mission import Mission
from scp_recon.mission.schedule import Schedule
from scp_recon.mission.windows import Window
from scp_recon.pass_design.ring import Ring
from scp_recon.pass_design.rules import ROOM_S, timing_rules

Array = npt.NDArray[np.float64]


@dataclass(frozen=True)
class Pass:
    """One choice.

    Attributes:
        phases: of departure and arrival on the ring, rad.
        times_s: of all burns past the design's epoch, the first the departure and the last the arrival.
    """

    phases: tuple[float, float]
    times_s: tuple[float, ...]


@dataclass(frozen=True)
class Space:
    """All choices with as many burns about one window, as vectors x = (phases, times / unit of time).

    Attributes:
        mission: any pass of the design; gives body, limits, units and rules.
        ring: home orbit.
        window_s: observation window, past the design's epoch.
        phase_spans: least and greatest phase of departure and of arrival, rad.
        time_spans: earliest and latest time of each burn, s; equal where it is fixed.
    """

    mission: Mission
    ring: Ring
    window_s: Window
    phase_spans: tuple[tuple[float, float], tuple[float, float]]
    time_spans: tuple[tuple[float, float], ...]

    @property
    def n_burns(self) -> int:
        """Number of burns."""
        return len(self.time_spans)

    @cached_property
    def bounds(self) -> Array:
        """Of x, shape (2 + m, 2)."""
        return np.vstack([self.phase_spans, np.array(self.time_spans) / self.mission.units.time_s])

    def rules(self, before: int) -> tuple[Array, Array]:
        """A and b of `timing_rules` on x, A x >= b, with some room.

        Args:
            before: burns between departure and window.
        """
        rules, unit = self.mission.scenario.schedule, self.mission.units.time_s
        matrix, least = timing_rules(self.n_burns, self.window_s, before, rules)
        return np.pad(matrix, ((0, 0), (2, 0))), (least + ROOM_S) / unit

    def before(self, times_s: tuple[float, ...]) -> int:
        """Burns between departure and window."""
        return burns_before(times_s, self.window_s)

    def vector(self, one: Pass) -> Array:
        """Point x of a pass."""
        return np.r_[one.phases, np.array(one.times_s) / self.mission.units.time_s]

    def at(self, x: Array) -> Pass:
        """The pass of x."""
        times = x[2:] * self.mission.units.time_s
        return Pass((float(x[0]), float(x[1])), tuple(map(float, times)))

    def on_grid(self, step_max_s: float) -> Space:
        """The same space with another longest spacing of nodes."""
        scenario = self.mission.scenario
        grid = scenario.grid.model_copy(update={"step_max_s": step_max_s})
        return replace(
            self,
            mission=replace(self.mission, scenario=scenario.model_copy(update={"grid": grid})),
        )

    def mission_of(self, one: Pass) -> Mission:
        """The mission of a pass, unchecked, its times past the design's epoch."""
        step = self.mission.scenario.grid.step_max_s
        return self._on_grid(one, make_grid((*one.times_s, *self.window_s), step))

    def moved(self, mission: Mission, one: Pass) -> Mission:
        """The mission of a near pass on the grid of another one, whose nodes move along.

        Nodes in the window stay, so that both have the same constraints there.
        """
        old = np.unique([*mission.scenario.burns.times_s, *self.window_s])
        new = np.unique([*one.times_s, *self.window_s])
        return self._on_grid(one, np.interp(mission.times_s, old, new))

    def _on_grid(self, one: Pass, times_s: Array) -> Mission:
        base = self.mission
        burns = base.scenario.burns.model_copy(update={"times_s": one.times_s})
        return replace(
            base,
            scenario=base.scenario.model_copy(update={"burns": burns}),
            initial_state=self.ring(one.phases[0]),
            final_state=self.ring(one.phases[1]),
            schedule=Schedule(self.window_s, (), ()),
            times_s=times_s,
        )
