"""Resolve a scenario into the planner's input: window, schedule, grid and problem.

This module is the border of `formulations`: SI and J2000 here, nondimensional there.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
import numpy.typing as npt
from scipy.linalg import block_diag

from formulations.arrays import Array, Indices
from formulations.linearisation.dynamics import Dynamics
from formulations.problem.controls import Feedback, FiringTimes
from formulations.problem.facets import Polytopes, ball, paper_ball
from formulations.problem.flow import by_parameters
from formulations.problem.flyby import FlybyProblem
from scp_recon.mission.checks import (
    check_plannable,
    check_scene,
    check_state,
    check_window,
    hinting,
)
from scp_recon.mission.constraints import (
    AS_PRINTED,
    Limit,
    observation_limits,
    problem_drifts,
    require_without,
    state_constraints,
)
from scp_recon.mission.feedback import felt_cut_offs_s, measurement_factors, picture_times_s
from scp_recon.mission.firing import HomePhases, firing_times
from scp_recon.mission.knowledge import Deviation, Uncertain
from scp_recon.mission.scene import (
    DEFAULT,
    RK4_STEP_MAX_S,
    Scene,
    Units,
    execution_errors,
    make_grid,
)
from scp_recon.mission.schedule import (
    BURNS_TO_MEET,
    MISS_WEIGHT,
    Interval,
    Schedule,
    find_window,
    make_schedule,
)
from scp_recon.mission.windows import EDGE_MOVES_S, Window, WindowEdges, moved_edges, scan_step_s
from scp_recon.physics import geometry
from scp_recon.physics.flow import GridFlow
from scp_recon.physics.forces import STEP, ForceModel, Partials
from scp_recon.physics.frames import Rotation
from scp_recon.physics.two_body import lambert
from scp_recon.scenario.fields import ScenarioWarning
from scp_recon.scenario.schema import Risk, Scenario

CLEARANCE_M, CLEARANCE_AGAIN_M = 200.0, 40.0
"""Facets farther than this from binding stay out of the convex program, and are checked after it.

The second figure is for starting at a solution of P2, which moves less than one of P3. Both are those
of the default mission, and grow with the unit of length.
"""
FLIGHT_STEPS = 1.2
"""Longest step of sampled flights over the longest spacing of nodes."""


@dataclass(frozen=True, eq=False, repr=False)
class Mission:
    """A scenario with its geometry resolved. States J2000, body-centred, SI.

    Attributes:
        scenario: that was resolved.
        rotation: of the body.
        site: on it, body-fixed.
        schedule: window, attitude modes, and legal burn times.
        units: of the nondimensional problem.
    """

    scenario: Scenario
    rotation: Rotation
    site: geometry.Site
    initial_state: Array
    """Mean before the first burn, or in flight at the first node, shape (6,)."""
    final_state: Array
    """Mean after the last burn, shape (6,)."""
    schedule: Schedule
    times_s: Array
    """Nodes of the grid, shape (n,)."""
    units: Units
    step_max_s: float = RK4_STEP_MAX_S
    """Longest Runge-Kutta step of the planner, s."""
    warnings: tuple[ScenarioWarning, ...] = ()
    """Warnings of unlikely entries, shown with every verdict."""
    firing_spans_s: tuple[Interval, ...] | None = None
    """Earliest and latest time of each burn to be planned, where times are controls; None if given."""
    home: HomePhases | None = None
    """Phases on the home orbit, where these and the flight's ends are controls too."""
    drift_losses: tuple[tuple[str, float], ...] = ()
    """Standard deviations by which drifts are less safe in flights than by the linear law, by names;
    infinite where tangent planes stand for that law."""
    pictured_m_s: Array | None = None
    """Burns of the path along which landmarks are pictured, shape (m, 3); None for a coast."""
    deviation: Deviation | None = None
    """Deviation of flights' parameters from the scenario's, which rotation and site have already."""
    nominal: Mission | None = None
    """The mission that this one deviates from."""

    def __repr__(self) -> str:
        """One line."""
        first, last = self.schedule.window_s
        name, nodes = self.scenario.name, len(self.times_s)
        return f"<Mission {name}: {nodes} nodes, window {first:.0f} to {last:.0f} s>"

    @classmethod
    def from_scenario(cls, scenario: Scenario, known: Mission | None = None) -> Mission:
        """Resolve a scenario; `known` gives window and warnings if only `in_flight` differs.

        Raises:
            InputError: if there is no window, a firing time breaks a rule of the schedule, or
                entries do not make sense together (`checks`).
        """
        scene = Scene.of(scenario)
        check_plannable(scene)
        with hinting(scene):
            before = known and scenario.model_copy(update={"in_flight": known.scenario.in_flight})
            if known is not None and known.scenario == before:
                window, warnings = known.schedule.window_s, known.warnings
            else:
                warnings = check_scene(scene)
                step = scan_step_s(scene.rotation.rate, (0.0, scenario.duration_s))
                window = find_window(scenario, scene.lighting, step)
                warnings += check_window(scene, window)
            schedule = make_schedule(
                scenario.burns.times_s,
                window,
                scenario.schedule,
                observed=scenario.observation.required is not False,
            )
        start, cut_offs = scenario.start_s, felt_cut_offs_s(scene, window).values()
        fixed = start, *scenario.burn_times_s, *cut_offs, *window, *scenario.grid.nodes_s
        return cls(
            scenario=scenario,
            rotation=scene.rotation,
            site=scene.site,
            initial_state=scene.initial_state,
            final_state=scene.boundary_state("final"),
            schedule=schedule.after(scenario),
            times_s=make_grid([time for time in fixed if time >= start], scenario.grid.step_max_s),
            units=Units.of_orbit(scene.initial_state, scenario.body.gm_m3_s2),
            warnings=warnings + check_state(scene),
        )

    def changed(self, entries: Mapping[str, object], *words: ScenarioWarning) -> Mission:
        """The mission with other values of some entries; its warnings stay, with further ones.

        Raises:
            InputError: as `from_scenario`.
        """
        made = Mission.from_scenario(self.scenario.replace(entries))
        told = dict.fromkeys((*made.warnings, *self.warnings, *words))
        return replace(made, warnings=tuple(told), pictured_m_s=self.pictured_m_s)

    def along(self, burns_m_s: Array) -> Mission:
        """The mission whose pictures of landmarks, if any, are taken along the path of some burns."""
        if self.scenario.navigation.landmarks is None:
            return self
        return replace(self, pictured_m_s=burns_m_s)

    @cached_property
    def scene(self) -> Scene:
        """Body, site and Sun, and their axes."""
        return Scene(self.scenario, self.rotation, self.site, self.deviation)

    @cached_property
    def uncertain(self) -> Uncertain:
        """The law of the uncertain parameters."""
        return Uncertain.of(self.scenario)

    def deviating(self, deviation: Deviation) -> Mission:
        """The mission as flights with other parameters have it: body, site and forces deviate."""
        rotation, site = deviation.rotation(self.rotation), deviation.site(self.site)
        return replace(self, rotation=rotation, site=site, deviation=deviation, nominal=self)

    def of_flights(self, draws: Array) -> Mission:
        """The mission as flights have it whose parameters are draws, shape (flights, p)."""
        return self.deviating(self.uncertain.deviation(draws)) if self.uncertain.count else self

    def with_initial_state(self, state: Array) -> Mission:
        """The same mission from another state at its first node, J2000, SI, shape (6,); units are kept.

        Raises:
            ValueError: if it is not a finite state outside the body's reference radius.
        """
        state = np.asarray(state, dtype=float)
        radius = self.scenario.body.reference_radius_m
        if state.shape != (6,) or not np.isfinite(state).all():
            raise ValueError(f"an initial state has six finite components, not {state}")
        if np.linalg.norm(state[:3]) <= radius:
            raise ValueError(f"an initial state is outside the body, whose radius is {radius:g} m")
        flight, boundary = self.scenario.in_flight, self.scenario.boundary
        which, frame = ("", flight.frame) if flight else ("initial_", boundary.frame)
        matrix = self.scene.axes(frame)
        given: dict[str, object] = {} if flight else {"home": None}
        given[f"{which}position_m"] = tuple((matrix.T @ state[:3]).tolist())
        given[f"{which}velocity_m_s"] = tuple((matrix.T @ state[3:]).tolist())
        name, table = ("in_flight", flight) if flight else ("boundary", boundary)
        scenario = self.scenario.model_copy(update={name: table.model_copy(update=given)})
        return replace(self, scenario=scenario, initial_state=state.copy())

    def some_flights(self, flights: Indices | int) -> Mission:
        """The mission as some of the flights have it that it deviates for, or one."""
        if self.deviation is None:
            return self
        assert self.nominal is not None
        return self.nominal.deviating(self.deviation.at(flights))

    def sun_direction(self, time_s: npt.ArrayLike) -> Array:
        """Unit vectors from the body to the Sun, J2000, shape (..., 3)."""
        return self.scene.sun_direction(time_s)

    @property
    def forces(self) -> ForceModel:
        """Forces of the planner, SI, J2000."""
        return self.scene.planned

    @cached_property
    def partials(self) -> Partials | None:
        """Derivatives of the planner's forces by the uncertain parameters, SI.

        None without any, or where the parameters are those of flights.
        """
        if not self.uncertain.count or self.deviation is not None:
            return None
        turning = self.forces.field is not None
        return self.uncertain.partials(
            lambda deviation: self.deviating(deviation).forces, self.rotation, turning=turning
        )

    @cached_property
    def initial_factor(self) -> Array:
        """Factor S, where S S' is the covariance of the initial state, shape (6, 6)."""
        return self.scene.initial_factor(self.initial_state)

    @cached_property
    def feedback(self) -> Feedback | None:
        """Measurements of the corrected burns, nondimensional; None if no burn is corrected."""
        cut_offs = felt_cut_offs_s(self.scene, self.schedule.window_s)
        if not cut_offs:
            return None
        nodes = np.searchsorted(self.times_s, list(cut_offs.values()))
        if self.scenario.navigation.landmarks is None:
            measured = np.tile(self.scene.measurement_factor, (len(nodes), 1, 1))
        else:
            measured = self.measured_by_pictures(self.times_s[nodes])
        return Feedback(
            burns=np.array(list(cut_offs)),
            cut_offs=nodes,
            measurement=measured / self.units.state[:, None],
            cost=self.scenario.policy.cost,
            probability=self.scenario.risk.p_chance,
            considers=self.uncertain.count > 0 and self.estimated == 0,
        )

    @property
    def estimated(self) -> int:
        """Number of uncertain parameters that the filter of a flight estimates."""
        considers = self.scenario.navigation.estimate_parameters is False
        return 0 if considers else self.uncertain.count

    def measured_by_pictures(self, cut_offs_s: Array) -> Array:
        """Factors N of the covariances N N' of states that pictures tell at times (k,), (k, 6, 6); SI.

        Before there is a plan the pictures are taken on a coast: on Lambert's arc of less than half a
        revolution to the final position; where there is none, with the initial velocity.

        Raises:
            InputError: if no picture shows a landmark before a cut-off along the path of some burns.
        """
        if self.nominal is not None:
            return self.nominal.measured_by_pictures(cut_offs_s)
        pictures = picture_times_s(self.scenario, cut_offs_s[-1])
        times = np.unique(np.concatenate([self.times_s, pictures, cut_offs_s]))
        dynamics, start = replace(self, times_s=times).dynamics, self.initial_state.copy()
        burns, executed = np.zeros((len(dynamics.burn_nodes), 3)), None
        if self.pictured_m_s is not None:
            burns, executed = self.pictured_m_s, np.zeros((len(times), 3, 3))
            columns = execution_errors(self.scenario).columns(burns)
            executed[dynamics.burn_nodes] = columns @ columns.mT
        else:
            span = float(times[-1] - times[0])
            arc = lambert(start[:3], self.final_state[:3], span, self.scenario.body.gm_m3_s2)
            start[3:] = start[3:] if arc is None else arc[0]
        states = dynamics.rollout(start / self.units.state, burns / self.units.speed_m_s)
        arcs, p = dynamics.flow.differentiate(states[:-1]), self.uncertain.count
        units, stm = self.state_units(6 + p), np.tile(np.eye(6 + p), (len(times), 1, 1))
        stm[1:, :6] = np.concatenate([arcs.stm, by_parameters(arcs, p)], axis=2)
        prior = units[:, None] * self.joint_factor
        path = times, states[:, :3] * units[:3], units[:, None] * stm / units
        known = self.scene, self.uncertain, path, executed, prior @ prior.T
        return measurement_factors(*known, cut_offs_s)

    @property
    def joint_factor(self) -> Array:
        """Nondimensional factor of the initial state and the p uncertain parameters, (6 + p, 6 + p)."""
        return self._joint(self.initial_factor / self.units.state[:, None])

    def _joint(self, factor: Array) -> Array:
        count = self.uncertain.count
        return np.asarray(block_diag(factor, np.eye(count))) if count else factor

    def state_units(self, size: int) -> Array:
        """Units of the state and of uncertain parameters below it, shape (size,)."""
        return np.r_[self.units.state, np.ones(size - 6)]

    @property
    def burn_nodes(self) -> Indices:
        """Node of each burn to be planned."""
        return np.searchsorted(self.times_s, self.scenario.burn_times_s)

    @property
    def kept_window_s(self) -> Window | None:
        """Window that burns keep out of, whole; None if no observation is required."""
        return None if self.scenario.observation.required is False else self.schedule.window_s

    @property
    def observed_s(self) -> tuple[float, float] | None:
        """Observation window from the first node on; None if it is over, or not required."""
        if self.kept_window_s is None:
            return None
        first, last = self.kept_window_s
        start = float(self.times_s[0])
        return (max(first, start), last) if last > start else None

    @cached_property
    def edges(self) -> WindowEdges:
        """Edges of the observation window, which may move with the body's spin and the site."""
        if self.nominal is not None:
            return self.nominal.edges
        first, last = self.times_s[[0, -1]].tolist()
        observed, moves, sigmas = self.observed_s, STEP * np.eye(self.uncertain.count), None
        if observed and self.scenario.observation.window_s is None and len(moves):
            ahead, behind = (self.of_flights(sign * moves).own_edges_s for sign in (1.0, -1.0))
            found = np.linalg.norm((ahead - behind) / (2.0 * STEP), axis=1)
            sigmas = np.asarray(found) if found.max() > EDGE_MOVES_S else None
        return WindowEdges(observed, sigmas, (first, last))

    @property
    def own_edges_s(self) -> Array:
        """Edges of the window in the flights that the mission deviates for, s, shape (2, flights)."""
        slack = self.scene.lighting.slack(self.scenario.observation)
        return moved_edges(slack, self.schedule.window_s)

    @property
    def must_meet(self) -> bool:
        """Whether the final state is a condition; it is not with too few burns left to meet it."""
        return len(self.scenario.burn_times_s) >= BURNS_TO_MEET

    @property
    def window_nodes(self) -> Indices:
        """Nodes in the rest of the observation window, edges included; none if it is over."""
        if self.observed_s is None:
            return np.zeros(0, dtype=np.intp)
        first, last = self.observed_s
        return np.flatnonzero((self.times_s >= first) & (self.times_s <= last))

    @cached_property
    def limits(self) -> tuple[Limit, ...]:
        """Limits on the position relative to the site in the window."""
        return observation_limits(self.scenario)

    @cached_property
    def problem(self) -> FlybyProblem:
        """The nondimensional problem on this mission's grid."""
        units, scenario, firing = self.units, self.scenario, self.firing
        # Limits on the sigmas after the last burn, None where there is none.
        position = scenario.boundary.final_sigma_position_m
        speed = scenario.boundary.final_sigma_velocity_m_s
        problem = FlybyProblem(
            n_nodes=len(self.times_s),
            burn_nodes=self.burn_nodes,
            initial_state=self.initial_state / units.state,
            final_state=self.final_state / units.state,
            initial_factor=self.joint_factor,
            execution_errors=execution_errors(scenario, units.speed_m_s),
            dv_max=scenario.burns.dv_max_m_s / units.speed_m_s,
            sun=self.sun_direction(np.array(scenario.burn_times_s)),
            dv_cone=float(np.deg2rad(scenario.battery.delta_v_cone_deg)),
            constraints=state_constraints(
                self.scene,
                self.limits,
                self.uncertain,
                self.times_s,
                self.window_nodes,
                units.length_m,
            ),
            miss_weight=None if self.must_meet else MISS_WEIGHT,
            final_spread=(
                position and position / units.length_m,
                speed and speed / units.speed_m_s,
            ),
            feedback=self.feedback,
            firing=firing,
            drifts=tuple(
                problem_drifts(
                    self.scene, self.forces, self.partials, units, dict(self.drift_losses)
                )
            ),
        )
        return problem if firing is None else problem.at(firing.start)

    @property
    def firing(self) -> FiringTimes | None:
        """Firing times and phases that are controls, nondimensional; None if all are given."""
        if self.firing_spans_s is None:
            return None
        nodes, spans = (self.times_s, self.burn_nodes, self.window_nodes), self.firing_spans_s
        window, unit = self.kept_window_s, self.units.time_s
        home, units = None, self.units.state

        def factor_at(state: Array) -> Array:
            return self._joint(self.scene.initial_factor(state, signed=True) / units[:, None])

        if self.home is not None:
            home = self.home, self.home.boundary(units, factor_at)
        return firing_times(self.scenario, window, nodes, spans, unit, home, self.feedback)

    @cached_property
    def polytopes(self) -> Polytopes:
        """Polytopes that approximate balls and cones in P2."""
        choice, shape = self.scenario.polytopes, None
        if choice.ball != "tangent":
            shape = paper_ball() if choice.ball == "paper" else ball(choice.ball)
        return Polytopes(shape, 4 if choice.cone == "paper" else choice.cone)

    @property
    def risk(self) -> Risk:
        """Required probability, its scope, and how risk is spent."""
        return self.scenario.risk

    @property
    def clearances(self) -> tuple[float, float]:
        """`CLEARANCE_M` and `CLEARANCE_AGAIN_M`, nondimensional."""
        return CLEARANCE_M / DEFAULT.length_m, CLEARANCE_AGAIN_M / DEFAULT.length_m

    def require_plain(self, needs: str) -> None:
        """Refuse feedback, drifts, knowledge and limits on the final covariance.

        They go with `needs` alone.

        Raises:
            InputError: if there is any.
        """
        require_without(("drifts", *AS_PRINTED), self.scenario, needs)

    @cached_property
    def flow(self) -> GridFlow:
        """Nondimensional flow map of the grid's arcs."""
        forces = self.forces.in_units(self.units.length_m, self.units.time_s)
        times = self.times_s / self.units.time_s
        durations = np.diff(self.times_s) / self.units.time_s
        partials = self.partials
        if partials is not None:
            partials = partials.in_units(self.units.length_m, self.units.time_s)
        return GridFlow(forces, times[:-1], durations, self.arc_substeps, partials)

    @cached_property
    def dynamics(self) -> Dynamics:
        """Nondimensional flow map of the grid with the burns."""
        return Dynamics(self.flow, self.burn_nodes)

    @property
    def arc_substeps(self) -> int:
        """Runge-Kutta steps per arc, so that none is longer than `step_max_s`."""
        return max(1, int(np.ceil(np.max(np.diff(self.times_s)) / self.step_max_s)))

    @property
    def flight_step_s(self) -> float:
        """Longest Runge-Kutta step of sampled flights, s: shorter where a finer grid was needed.

        Nodes that are added between do not change it, so that flights stay as they are.
        """
        return min(RK4_STEP_MAX_S, FLIGHT_STEPS * self.scenario.grid.step_max_s)
