"""Define the design space: two phases on the ring and the times of all burns, within their spans."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.optimize import linprog

from scp_recon.mission.feedback import felt_cut_offs_s
from scp_recon.mission.firing import Ring
from scp_recon.mission.mission import Mission
from scp_recon.mission.scene import RK4_STEP_MAX_S, make_grid
from scp_recon.mission.schedule import Schedule, burns_before, timing_rules
from scp_recon.mission.windows import Window
from scp_recon.scenario.schema import Scenario, ScheduleRules

Span = tuple[float, float]


@dataclass(frozen=True)
class Pass:
    """A pass: phases of departure and arrival on the ring, rad, and the times of all burns.

    Times are in s past the design's epoch, the first the departure's and the last the arrival's.

    Attributes:
        phases: of departure and arrival.
        times_s: of all burns.
    """

    phases: tuple[float, float]
    times_s: tuple[float, ...]


@dataclass(frozen=True, eq=False)
class Space:
    """All passes with one number of burns about one window; times are past the design's epoch."""

    mission: Mission
    """Mission of any pass of the design, for body, limits, units and rules."""
    ring: Ring
    """Home orbit."""
    window_s: Window
    """Observation window."""
    phase_spans: tuple[Span, Span]
    """Least and greatest phase of departure and of arrival, rad."""
    time_spans: tuple[Span, ...]
    """Earliest and latest time of each burn, s; equal where it is fixed."""
    times_s: tuple[float, ...] = ()
    """Legal times from which its first passes start."""
    begin_s: float = 0.0
    """The design's epoch, past the scenario's."""
    number: int = 0
    """Number of the lighting window, from 0."""
    step_max_s: float = 2.0 * RK4_STEP_MAX_S
    """Longest Runge-Kutta step, s: the pass that is found is planned again with shorter ones."""

    @property
    def has_home(self) -> bool:
        """Whether passes begin and end on a home orbit; otherwise boundary states are given."""
        return self.mission.scenario.boundary.home is not None

    def before(self, times_s: Sequence[float]) -> int:
        """Burns between departure and window."""
        return burns_before(times_s, self.window_s)

    def nearest_legal(
        self, times_s: Sequence[float], room_s: float = 0.0
    ) -> tuple[float, ...] | None:
        """Times within its spans and rules, the nearest to given ones: see `nearest_legal`."""
        rules, window = self.mission.scenario.schedule, self.window_s
        kept = None if self.mission.kept_window_s is None else window
        before = self.before(times_s)
        return nearest_legal(times_s, self.time_spans, kept, before, rules, room_s)

    def coarser(self, factor: float) -> Space:
        """The same space with longer spacings of nodes and integration steps."""
        grid = {"step_max_s": factor * self.mission.scenario.grid.step_max_s}
        mission = replace(self.mission, scenario=unchecked(self.mission.scenario, grid=grid))
        return replace(self, mission=mission, step_max_s=factor * self.step_max_s)

    def mission_of(self, one: Pass) -> Mission:
        """The mission of a pass, without checks."""
        made = replace(
            self.mission,
            scenario=unchecked(self.mission.scenario, burns={"times_s": one.times_s}),
            initial_state=self.ring(one.phases[0]),
            final_state=self.ring(one.phases[1]),
            schedule=Schedule(self.window_s, (), ()),
            step_max_s=self.step_max_s,
        )
        cut_offs = felt_cut_offs_s(made.scene, self.window_s).values()
        times = *one.times_s, *self.window_s, *cut_offs
        return replace(made, times_s=make_grid(times, self.mission.scenario.grid.step_max_s))

    def with_policy_of(self, scenario: Scenario) -> Space:
        """The same space with a scenario's policy."""
        own = self.mission.scenario.model_copy(update={"policy": scenario.policy})
        return replace(self, mission=replace(self.mission, scenario=own))


def unchecked(scenario: Scenario, **tables: Mapping[str, object]) -> Scenario:
    """The same scenario with other entries in some tables, without checks or computed entries."""
    changed = {
        name: getattr(scenario, name).model_copy(update=dict(entries))
        for name, entries in tables.items()
    }
    return scenario.model_copy(update=changed)


def nearest_legal(
    times_s: Sequence[float],
    spans_s: Sequence[Span],
    window_s: Window | None,
    before: int,
    rules: ScheduleRules,
    room_s: float = 0.0,
) -> tuple[float, ...] | None:
    """Times within spans and rules, the nearest to given ones by the sum of differences; or None.

    With some room, if wanted, to each rule.
    """
    n, wanted = len(times_s), np.array(times_s)
    matrix, least, _ = timing_rules(n, window_s, before, rules)
    apart = np.vstack([np.hstack([s * np.eye(n), -np.eye(n)]) for s in (1.0, -1.0)])
    result = linprog(
        np.r_[np.zeros(n), np.ones(n)],
        A_ub=np.vstack([apart, np.hstack([-matrix, np.zeros_like(matrix)])]),
        b_ub=np.r_[wanted, -wanted, -least - room_s],
        bounds=[*spans_s, *[(0.0, None)] * n],
    )
    return None if result.x is None else tuple(map(float, result.x[:n]))
