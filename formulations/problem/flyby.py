"""The flyby problem as data: arcs, burns, legs, limits, drifts; and iterates of burns and means."""

from __future__ import annotations

import itertools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Literal

import numpy as np

from formulations.arrays import Array, Indices
from formulations.problem.controls import UNIT, Feedback, FiringTimes
from formulations.problem.execution_errors import ExecutionErrors
from formulations.problem.flow import Flow
from formulations.problem.regions import Ball, Cone, Motion, Region


@dataclass(frozen=True, eq=False)
class Drift:
    """The flight from a burn's node on, if only a share of that burn happens and no burn follows.

    A cut burn adds its share of the burn, of its correction and of the errors of both. Between mean
    and factor just before the burn, (mu-, S-), and just after it, (mu+, S+), the drift begins at

        (1 - share) (mu-, S-) + share (mu+, S+).

    Attributes:
        name: unique among the problem's drifts and constraints.
        burn: index of the burn.
        share: of the burn that happens; 0 where it is missed.
        flow: the motion along the drift's arcs, in the units of the problem.
        keep_out: balls that the drift keeps out of, each with a centre per node of the drift.
        required: Phi^-1 of the probability that the whole drift keeps out of all of them.
        by_planes: whether tangent planes stand for the linear law, which misses what the flow bends.
    """

    name: str
    burn: int
    share: float
    flow: Flow
    keep_out: tuple[Ball, ...]
    required: float
    by_planes: bool = False

    def shrunk(self, share: float) -> Drift:
        """The same that keeps out of balls of a share of their radius."""
        balls = (replace(ball, radius=share * ball.radius) for ball in self.keep_out)
        return replace(self, keep_out=tuple(balls))


@dataclass(frozen=True, eq=False)
class StateConstraint:
    """The position at `nodes` stays in, or out of, a region with the given probability.

    Attributes:
        name: unique among the problem's constraints.
        nodes: node indices, shape (n,).
        region: one region per node.
        keep: "in" or "out".
        probability: required of this constraint alone in P2, after joint risk was split.
        joint: name of the joint chance constraint it belongs to; by default its own.
        motion: of the region with the problem's uncertain parameters; None if it stays.
    """

    name: str
    nodes: Indices
    region: Region
    keep: Literal["in", "out"]
    probability: float
    joint: str = ""
    motion: Motion | None = None

    @property
    def event(self) -> str:
        """Name of the joint constraint that must hold with the required probability."""
        return self.joint or self.name

    def margin(self, mean: Array) -> Array:
        """Signed distance to the region's surface at each node, >= 0 where satisfied, (n,)."""
        inside = self.region.inside(mean[self.nodes, :3])
        return inside if self.keep == "in" else -inside


NO_GAINS = np.zeros(0)
"""Gains where all burns are fixed before departure, or where corrections are not planned yet."""

NO_TIMES = np.zeros(0)
"""Firing times where these are those of the grid."""


@dataclass(frozen=True, eq=False)
class Iterate:
    """Burns (m, 3) and node means (n_nodes, 6), which may have defects.

    Attributes:
        burns: velocities added, shape (m, 3).
        mean: states at the nodes, shape (n_nodes, 6).
        gains: of the corrected burns, as `Feedback` orders them.
        times: and phases that `FiringTimes` moves, shape (q,); empty where these are the grid's.
        drifts: means of free drifts by their names, near these: where the search for these starts.
    """

    burns: Array
    mean: Array
    gains: Array = field(default_factory=NO_GAINS.copy)
    times: Array = field(default_factory=NO_TIMES.copy)
    drifts: Mapping[str, Array] = field(default_factory=dict)

    @property
    def total_dv(self) -> float:
        """Sum of the burns' sizes."""
        return float(np.linalg.norm(self.burns, axis=1).sum())


class Legs:
    """The legs of a grid: the arcs from one burn to the next, or from the start to the first burn.

    A linear map along a leg is a product of its arcs' matrices from its start; `compose` makes those
    products once for all nodes.

    Args:
        n_nodes: nodes of the grid.
        starts: nodes at which legs start, and the last node, where a burn ends the last one; ascending
            from 0 to n_nodes - 1.

    Attributes:
        of: leg in which each node is reached, shape (n_nodes,); the first node counts to leg 0.
        ends: node at which each leg ends, shape (legs,).
    """

    def __init__(self, n_nodes: int, starts: Indices) -> None:
        self.of = np.maximum(np.searchsorted(starts, np.arange(n_nodes)) - 1, 0)
        self.ends = starts[1:]
        length = round(np.sqrt(n_nodes))
        blocks: list[Indices] = []
        self._continued: list[int] = []
        for first, last in itertools.pairwise(starts.tolist()):
            for start in range(first, last, length):
                arcs = np.arange(start, start + length)
                if start > first:
                    self._continued.append(len(blocks))
                blocks.append(np.where(arcs < last, arcs, n_nodes - 1))
        self._blocks = np.array(blocks)
        self._arcs = self._blocks.ravel() < n_nodes - 1

    def compose(self, maps: Array) -> Array:
        """Products (n_nodes, d, d) of the arcs' matrices (n_nodes - 1, d, d) from each leg's start.

        The identity at the first node. Within blocks of about sqrt(n) arcs, all blocks at a time; then
        from block to block. Blocks that a leg does not fill end in identities.
        """
        one = np.eye(maps.shape[-1])[None]
        blocks = np.concatenate([maps, one])[self._blocks]
        for j in range(1, blocks.shape[1]):
            blocks[:, j] = blocks[:, j] @ blocks[:, j - 1]
        for b in self._continued:
            blocks[b] = blocks[b] @ blocks[b - 1, -1]
        return np.concatenate([one, blocks.reshape(-1, *one.shape[1:])[self._arcs]])


@dataclass(frozen=True, eq=False)
class FlybyProblem:
    """Boundary states, burns, uncertainty and constraints on a grid of `n_nodes`; nondimensional.

    Node states are those after the burn where one falls on the node, so that
    mu_0 = x_0 + B dv_0 and mu_{k+1} = F_k(mu_k) + B dv_i where burn i is at node k + 1. A flight
    that is under way may coast before its first burn; then mu_0 = x_0.

    Attributes:
        n_nodes: nodes of the grid, arcs plus one.
        burn_nodes: node of each burn, ascending, the last n_nodes - 1, shape (m,).
        initial_state: mean at the first node, before a burn there, shape (6,).
        final_state: mean after the last burn, shape (6,).
        initial_factor: S with S S' its covariance, and below it the factor of p uncertain constants
            of the flow and of the regions, shape (6 + p, c).
        execution_errors: of the burns.
        dv_max: largest burn.
        sun: unit vectors to the Sun at each burn, shape (m, 3).
        dv_cone: half-angle of the double cone about the Sun line that burns must avoid; 0 for none.
        constraints: on the position.
        miss_weight: price of each component of the final state's miss, for too few burns to meet
            the final state; None makes the final state a condition.
        final_spread: limits on the root of the summed variances of the position and of the velocity
            after the last burn, None where there is none.
        held: burns that keep the value that they have in an iterate.
        raised: burns of at least `dv_min`, as they are in an iterate.
        dv_min: smallest size of a burn that is raised.
        feedback: measurements and gains of the corrected burns; None if all burns are fixed before
            departure.
        firing: times and phases that are controls; None if all are given.
        phases: of the boundary states, rad, if they were set by `at`.
        drifts: free flights after a missed or cut burn, which P2 keeps out of regions.
    """

    n_nodes: int
    burn_nodes: Indices
    initial_state: Array
    final_state: Array
    initial_factor: Array
    execution_errors: ExecutionErrors
    dv_max: float
    sun: Array
    dv_cone: float
    constraints: tuple[StateConstraint, ...]
    miss_weight: float | None = None
    final_spread: tuple[float | None, float | None] = (None, None)
    held: tuple[int, ...] = ()
    raised: tuple[int, ...] = ()
    dv_min: float = 0.0
    feedback: Feedback | None = None
    firing: FiringTimes | None = None
    phases: tuple[float, float] | None = None
    drifts: tuple[Drift, ...] = ()

    def __post_init__(self) -> None:
        """Refuse an error that all burns share where several are corrected: no filter estimates it."""
        several = self.feedback is not None and len(self.feedback.burns) > 1
        if several and self.execution_errors.shared:
            raise ValueError("with several corrected burns no error may be common to all burns")

    @cached_property
    def open_loop(self) -> FlybyProblem:
        """The same problem with all burns fixed before departure."""
        return self if self.feedback is None else replace(self, feedback=None)

    @property
    def n_burns(self) -> int:
        """Number of burns."""
        return len(self.burn_nodes)

    @cached_property
    def legs(self) -> Legs:
        """The arcs between the burns, and before the first one."""
        return Legs(self.n_nodes, self.leg_starts)

    @property
    def coasts(self) -> int:
        """Legs before the first burn: one, or none."""
        return int(self.burn_nodes[0] > 0)

    @cached_property
    def leg_starts(self) -> Indices:
        """Nodes at which legs start, the last node included; burn i is at the one of i + `coasts`."""
        return np.r_[np.zeros(self.coasts, dtype=np.intp), self.burn_nodes]

    @property
    def parameters(self) -> int:
        """Number p of uncertain constants, which the factor carries along below the state."""
        return len(self.initial_factor) - 6

    @cached_property
    def parameter_factor(self) -> Array:
        """Rows of the parameters in the covariance factor, the same at every node, shape (p, c)."""
        rows = self.initial_factor[6:]
        return np.pad(rows, ((0, 0), (0, self.factor_columns - rows.shape[1])))

    @cached_property
    def first_factor(self) -> Array:
        """The factor before the first burn with its columns that all burns share, still zero."""
        return np.pad(self.initial_factor, ((0, 0), (0, self.execution_errors.shared)))

    @property
    def factor_columns(self) -> int:
        """Columns of the covariance factor: initial ones, those that burns share, each burn's own."""
        return self.columns_before(self.n_burns)

    def columns_before(self, burns: int) -> int:
        """Number of columns of the covariance factor after a number of burns."""
        return int(self._first_columns[burns])

    @cached_property
    def _first_columns(self) -> Indices:
        """First column of each burn's own: its errors, its correction's, and its measurement's."""
        own = np.full(self.n_burns, self.execution_errors.own)
        if self.feedback is not None:
            for j, burn in enumerate(self.feedback.burns):
                own[burn] += self.execution_errors.of_correction(6 * (j + 1)) + 6
        return self.first_factor.shape[1] + np.cumsum([0, *own])

    def columns_of_correction(self, j: int) -> tuple[slice, slice]:
        """The factor's columns of errors in executing the correction j, and in measuring before it."""
        assert self.feedback is not None
        burn = int(self.feedback.burns[j])
        stop = self.columns_before(burn + 1)
        return slice(self.columns_of_burn(burn).stop, stop - 6), slice(stop - 6, stop)

    @property
    def shared_columns(self) -> slice:
        """The factor's columns that the execution errors of all burns fill."""
        first = self.initial_factor.shape[1]
        return slice(first, first + self.execution_errors.shared)

    def columns_of_burn(self, burn: int) -> slice:
        """The factor's columns that the execution error of one planned burn alone fills."""
        first = self.columns_before(burn)
        return slice(first, first + self.execution_errors.own)

    @cached_property
    def controls_before(self) -> Indices:
        """Number of controls of a number of burns, shape (m + 1,).

        Of each burn its components, then its gains, then its time and phase if these are controls.
        """
        own = np.full(self.n_burns, 3)
        own += np.bincount(self._owners, minlength=self.n_burns)
        if self.feedback is not None:
            own[self.feedback.burns] += np.diff(self.feedback.first_gain)
        return np.cumsum([0, *own])

    @cached_property
    def burn_controls(self) -> Indices:
        """The controls that are components of burns, shape (m, 3)."""
        return self.controls_before[:-1, None] + np.arange(3)

    def controls_of(self, burns: Sequence[int]) -> Indices:
        """The controls of some burns, their gains included."""
        first = self.controls_before
        parts = [np.arange(first[burn], first[burn + 1]) for burn in burns]
        return np.concatenate([np.zeros(0, np.intp), *parts])

    def commanded_controls(self, j: int) -> slice:
        """The controls of the corrected burn j without its time: its components and its gains."""
        assert self.feedback is not None
        first = int(self.controls_before[self.feedback.burns[j]])
        return slice(first, first + 3 + 18 * (j + 1))

    @cached_property
    def gain_controls(self) -> Indices:
        """The controls that are gains, shape (gains,)."""
        return np.setdiff1d(np.arange(self.controls_before[-1]), self.moving_controls)

    @cached_property
    def time_controls(self) -> Indices:
        """The controls that are firing times and phases, in `controls.UNIT`, shape (q,)."""
        owners = self._owners
        left = [int(np.sum(owners[i:] == owner)) for i, owner in enumerate(owners)]
        return self.controls_before[owners + 1] - np.array(left, dtype=np.intp)

    @cached_property
    def _owners(self) -> Indices:
        """Burn to which each of the firing times and phases belongs, shape (q,)."""
        if self.firing is None:
            return np.zeros(0, dtype=np.intp)
        return self.firing.owners(self.n_burns - 1)

    @cached_property
    def moving_controls(self) -> Indices:
        """The controls that move means: components of burns, firing times and phases."""
        return np.union1d(self.burn_controls, self.time_controls)

    def firing_times(self, times: Array) -> Array:
        """Times and phases that move: those given, or if none the grid's; shape (q,)."""
        return times if self.firing is None or times.size else self.firing.start

    def at(self, times: Array) -> FlybyProblem:
        """The problem with the boundary states of times and phases (q,); itself if no phase moves."""
        if self.firing is None or self.firing.boundary is None or not times.size:
            return self
        first, last = self.firing.phases(times).tolist()
        if self.phases == (first, last):
            return self
        state, factor = self.firing.boundary.first(first)
        final, phases = self.firing.boundary.last(last), (first, last)
        return replace(
            self, initial_state=state, initial_factor=factor, final_state=final, phases=phases
        )

    def controls(self, burns: Array, gains: Array, times: Array = NO_TIMES) -> Array:
        """Burns (m, 3), firing times and gains in one vector: see `controls_before`."""
        controls = np.zeros(self.controls_before[-1])
        controls[self.burn_controls] = burns
        controls[self.time_controls] = self.firing_times(times) / UNIT
        if gains.size:
            controls[self.gain_controls] = gains
        return controls

    def without_corrections(self, gains: Array, burns: Indices) -> Array:
        """The gains with those of some burns set to zero."""
        if self.feedback is None or not gains.size:
            return gains
        gains = gains.copy()
        for j in np.flatnonzero(np.isin(self.feedback.burns, burns)):
            gains[self.feedback.first_gain[j] : self.feedback.first_gain[j + 1]] = 0.0
        return gains

    def gains_of(self, iterate: Iterate, j: int) -> Array:
        """Gains of the corrected burn j, shape (3, 6 (j + 1)); zero where none are planned yet."""
        assert self.feedback is not None
        if not iterate.gains.size:
            return np.zeros((3, 6 * (j + 1)))
        return self.feedback.of_burn(iterate.gains, j)

    def defects(self, iterate: Iterate, arcs: Array) -> Array:
        """Defects F_k(mu_k) + B dv - mu_{k+1} per arc, and last mu_N - x_f; shape (n_nodes, 6)."""
        defect = arcs - iterate.mean[1:]
        later = self.burn_nodes > 0
        defect[self.burn_nodes[later] - 1, 3:] += iterate.burns[later]
        return np.vstack([defect, iterate.mean[-1] - self.final_state])

    @cached_property
    def burn_cones(self) -> tuple[Cone, Cone]:
        """The two nappes of the cone that burns must avoid, apex at zero."""
        apex = np.zeros((self.n_burns, 3))
        return Cone(apex, self.sun, self.dv_cone), Cone(apex, -self.sun, self.dv_cone)

    def burn_margins(self, burns: Array) -> dict[str, Array]:
        """Margins of the limits on burns (m, ..., 3), >= 0 where satisfied, (m, ...) each."""
        toward, away = (-cone.inside(burns) for cone in self.burn_cones)
        return {
            "dv_max": self.dv_max - np.linalg.norm(burns, axis=-1),
            "dv_battery": np.minimum(toward, away),
        }


def factor_columns_used(problem: FlybyProblem, nodes: Indices) -> int:
    """Number of first factor columns that can affect the position at the ascending `nodes`.

    A burn's error shifts positions only after its node, so later burns' own columns stay zero.
    """
    burns_before = int(np.searchsorted(problem.burn_nodes, nodes[-1])) if len(nodes) else 0
    return problem.columns_before(burns_before)
