"""Flow map of all arcs at once, with its first- and second-order sensitivities.

Fourth-order Runge-Kutta with a fixed number of substeps. Differentiating the scheme and applying
the scheme to the variational equations are the same thing, so the sensitivities returned here are
the exact derivatives of the discrete map, not approximations of those of the continuous one.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np

from formulations.arrays import Array, Indices
from scp_recon.physics.forces import (
    ForceModel,
    Moment,
    Partials,
    accelerations,
    gravity_curvature,
    gravity_gradient,
)


@dataclass(frozen=True, eq=False)
class FlowDerivatives:
    """Arc-wise end states and sensitivities.

    Attributes:
        state: F(x), shape (n, 6).
        stm: A[n, i, j] = dF_i/dx_j, shape (n, 6, 6).
    """

    state: Array
    stm: Array
    _steps: tuple[_Stages, ...] = field(repr=False)
    _forces: ForceModel = field(repr=False)
    _partials: Partials | None = field(default=None, repr=False)

    @property
    def tensor(self) -> Array:
        """Second derivatives d2F_i/dx_j dx_k, shape (n, 6, 6, 6), symmetric in j and k.

        Computed at first use: P3 and Newton's method need no second derivatives.
        """
        return self._second[:, :, :6]

    @property
    def by_parameters(self) -> Array:
        """Derivatives dF_i/dw_j by the uncertain parameters, shape (n, 6, p)."""
        return self._moved_by_parameters[0]

    @property
    def mixed(self) -> Array:
        """Second derivatives d2F_i/dw_j dx_k, shape (n, 6, p, 6)."""
        return self._second[:, :, 6:]

    @cached_property
    def _moved_by_parameters(self) -> tuple[Array, list[Array]]:
        """Derivatives of the ends by parameters, and of each step's stages."""
        assert self._partials is not None
        n, p, stages = len(self.state), self._partials.count, list[Array]()
        end = np.zeros((n, 2, 3, p))
        for step in self._steps:
            position, time = step.position.reshape(-1, 3), step.time.ravel()
            push = self._partials.accelerations(position, time).reshape(4, n, 3, p)
            first, end = _first_order(end, step.gradient, step.h, push)
            stages.append(first)
        return end.reshape(n, 6, p), stages

    @property
    def _forced(self) -> Iterator[_Forced]:
        """What parameters do to each step's stages."""
        partials = self._partials
        assert partials is not None
        for step, first in zip(self._steps, self._moved_by_parameters[1], strict=True):
            slope = partials.gradients(step.position.reshape(-1, 3), step.time.ravel())
            yield _Forced(first, slope.reshape(*first.shape[:2], partials.count, 3, 3))

    @cached_property
    def _second(self) -> Array:
        """Second derivatives by parameters beside the state, and by the state, (n, 6, 6 + p, 6)."""
        n, p = len(self.state), 0 if self._partials is None else self._partials.count
        forced = list(self._forced) if p else [None] * len(self._steps)
        tensor = np.empty((n, 6, 6 + p, 6))
        for first in range(0, n, ARCS_AT_ONCE):
            arcs = slice(first, first + ARCS_AT_ONCE)
            part = np.zeros((len(tensor[arcs]), 2, 3, 6 * (6 + p)))
            for step, more in zip(self._steps, forced, strict=True):
                own = None if more is None else more.of(arcs)
                part = _second_order(part, step.of(arcs), self._forces, own)
            tensor[arcs] = part.reshape(-1, 6, 6 + p, 6)
        return tensor

    def moved(self, deviation: Array) -> FlowDerivatives:
        """The same with starts moved by deviations (n, 6) so small that first order gives the ends."""
        return replace(self, state=self.state + (self.stm @ deviation[:, :, None])[:, :, 0])

    def rate(self, state: Array, arcs: Indices) -> tuple[Array, Array]:
        """See `MovableDerivatives.rate`."""
        times = np.append(self._steps[0].time[0], self._steps[-1].time[-1, -1])
        time, p = times[arcs], 0 if self._partials is None else self._partials.count
        r, moment = state[:, :3], _moment(self._forces, time, arcs.shape)
        acceleration = np.asarray(accelerations(r.T, self._forces, moment)).T
        turn = np.zeros((len(arcs), 6, 6 + p))
        turn[:, :3, 3:6] = np.eye(3)
        turn[:, 3:, :3] = gravity_gradient(r, self._forces, moment)
        if self._partials is not None:
            turn[:, 3:, 6:] = self._partials.accelerations(r, time)
        return np.hstack([state[:, 3:], acceleration]), turn


ARCS_AT_ONCE = 32
"""Arcs per batch of second-order sensitivities, so that a batch stays in the processor's cache."""


@dataclass(frozen=True, eq=False)
class GridFlow:
    """The `formulations.problem.flow.Flow` of a grid's arcs, in the units of `forces`.

    Attributes:
        forces: acceleration of the spacecraft.
        starts: times at which arcs begin, from the epoch on, shape (n,).
        durations: of the arcs, shape (n,).
        substeps: Runge-Kutta steps per arc.
        partials: of the forces by uncertain parameters; None without any.
    """

    forces: ForceModel
    starts: Array
    durations: Array
    substeps: int
    partials: Partials | None = None

    @property
    def arcs(self) -> int:
        """Number of arcs."""
        return len(self.durations)

    def at(self, times: Array) -> GridFlow:
        """The flow along as many arcs between other times of the nodes, shape (n + 1,)."""
        return replace(self, starts=times[:-1], durations=np.diff(times))

    def propagate(self, state: Array, arc: int) -> Array:
        """Carry states (..., 6) along one arc."""
        start, duration = self.starts[arc], self.durations[arc]
        return propagate(state, duration, self.forces, self.substeps, start)

    def differentiate(self, state: Array) -> FlowDerivatives:
        """Derivatives of the first n arcs, from their starts (n, 6)."""
        first = slice(len(state))
        found = differentiate(
            state, self.durations[first], self.forces, self.substeps, self.starts[first]
        )
        return found if self.partials is None else replace(found, _partials=self.partials)


class _Stages(NamedTuple):
    """Stages of one Runge-Kutta step.

    Step lengths (n,), then for the four stages times (4, n), positions (4, n, 3), gravity
    gradients (4, n, 3, 3) and the positions' first derivatives (4, n, 3, 6).
    """

    h: Array
    time: Array
    position: Array
    gradient: Array
    first: Array

    def of(self, arcs: slice) -> _Stages:
        """Stages of some of the arcs."""
        return _Stages(self.h[arcs], *(part[:, arcs] for part in self[1:]))


class _Forced(NamedTuple):
    """Derivatives by p parameters at the stages.

    Of positions, shape (4, n, 3, p), and of gravity gradients, shape (4, n, p, 3, 3).
    """

    first: Array
    slope: Array

    def of(self, arcs: slice) -> _Forced:
        """Stages of some of the arcs."""
        return _Forced(self.first[:, arcs], self.slope[:, arcs])


def propagate(
    state: Array,
    duration: Array | float,
    forces: ForceModel,
    substeps: int = 1,
    start: Array | float | None = None,
) -> Array:
    """Carry states over their arcs; `state` (..., 6), `duration` and `start` broadcast against (...).

    The time at which an arc starts is needed where forces depend on it.
    """
    begin, h = _begin(start, forces), np.asarray(duration) / substeps

    def rate(r: Array, time: Array) -> Array:
        moment = _moment(forces, time, r.shape[1:])
        return accelerations(r.reshape(3, -1), forces, moment).reshape(r.shape)

    r = np.moveaxis(np.asarray(state)[..., :3], -1, 0)
    v = np.moveaxis(np.asarray(state)[..., 3:], -1, 0)
    for k in range(substeps):
        times = [begin + (k * h + share * h) for share in SHARES]
        _, r, v = runge_kutta(r, v, h, rate, times)
    return np.moveaxis(np.concatenate([r, v]), 0, -1)


def _begin(start: Array | float | None, forces: ForceModel) -> Array:
    if start is None and forces.timed:
        raise ValueError("forces that depend on time: expected the times at which arcs start")
    return np.asarray(0.0 if start is None else start)


def _moment(forces: ForceModel, time: Array, shape: tuple[int, ...]) -> Moment | None:
    """Surroundings at times, of positions of a shape in a row."""
    return forces.moment(np.broadcast_to(time, shape).ravel()) if forces.timed else None


SHARES = (0.0, 0.5, 0.5, 1.0)
"""Shares of a step's length at its four stages."""


def runge_kutta(
    r: Array, v: Array, h: Array | float, rate: Callable[[Array, Any], Array], known: Iterable[Any]
) -> tuple[tuple[Array, ...], Array, Array]:
    """Positions of the four stages of a Runge-Kutta step, and position and velocity of its end.

    With a_i the accelerations at the stages, the classical scheme for r'' = a(r, t) is

        r_1 = r,  r_2 = r + h/2 v,  r_3 = r_2 + h^2/4 a_1,  r_4 = r + h v + h^2/2 a_2
        r+ = r + h v + h^2/6 (a_1 + a_2 + a_3),  v+ = v + h/6 (a_1 + 2 a_2 + 2 a_3 + a_4).

    The acceleration is a function of a stage's position and of what else is known there; so are its
    derivatives, of which the same step makes those of the end.
    """
    one, two, three, four = known
    half, full = r + (0.5 * h) * v, r + h * v
    a1, a2 = rate(r, one), rate(half, two)
    third, fourth = half + (0.25 * h * h) * a1, full + (0.5 * h * h) * a2
    a3, a4 = rate(third, three), rate(fourth, four)
    middle = a2 + a3
    end = full + (h * h / 6.0) * (a1 + middle), v + (h / 6.0) * (a1 + a4 + 2.0 * middle)
    return (r, half, third, fourth), *end


def interpolate(
    start: tuple[Array, Array], end: tuple[Array, Array], h: Array | float, u: Array | float
) -> tuple[Array, Array]:
    """Cubic Hermite position and velocity at the share u of an arc of length h.

    Over an arc of Runge-Kutta's length the position is as good as the scheme: its error is
    h^4 / 384 times the fourth derivative. Shapes need only broadcast.
    """
    (r0, v0), (r1, v1) = start, end
    chord = (r1 - r0) / h
    bend, twist = 3.0 * chord - 2.0 * v0 - v1, v0 + v1 - 2.0 * chord
    position = r0 + (h * u) * (v0 + u * (bend + u * twist))
    return position, v0 + u * (2.0 * bend + (3.0 * u) * twist)


def differentiate(
    state: Array,
    duration: Array,
    forces: ForceModel,
    substeps: int = 1,
    start: Array | float | None = None,
) -> FlowDerivatives:
    """Flow map and state-transition matrix of every arc in one call, its second-order tensor later.

    Initial states have shape (n, 6), durations and starts (n,), and `substeps` is Runge-Kutta steps per
    arc. The time at which an arc starts is needed where forces depend on it.
    """
    begin = _begin(start, forces)
    n, h = len(state), np.asarray(duration, dtype=float) / substeps
    r, v = np.asarray(state)[:, :3].T, np.asarray(state)[:, 3:].T
    stm = np.broadcast_to(np.eye(6).reshape(2, 3, 6), (n, 2, 3, 6))
    steps = []
    for k in range(substeps):
        time = begin + h * (k + np.array(SHARES)[:, None])
        moments = [_moment(forces, at, at.shape) for at in time]
        # The stages' positions come first: the gradients are evaluated at all of them at once.
        stages, r, v = runge_kutta(r, v, h, lambda at, own: accelerations(at, forces, own), moments)
        position, moment = np.stack(stages).transpose(0, 2, 1), _moment(forces, time, (4, n))
        gradient = gravity_gradient(position.reshape(-1, 3), forces, moment).reshape(4, n, 3, 3)
        first, stm = _first_order(stm, gradient, h)
        steps.append(_Stages(h, time, position, gradient, first))
    return FlowDerivatives(
        np.concatenate([r, v]).T.copy(), stm.reshape(n, 6, 6), tuple(steps), forces
    )


def _first_order(
    stm: Array, gradient: Array, h: Array, push: Array | Sequence[float] = (0.0,) * 4
) -> tuple[Array, Array]:
    """First derivatives of the stages' positions (4, n, 3, 6) and of the step's end (n, 2, 3, 6).

    Or those by p parameters, with the accelerations' own derivatives by these, shape (4, n, 3, p).
    """
    known = zip(gradient, push, strict=True)
    stages, *end = runge_kutta(
        stm[:, 0], stm[:, 1], h[:, None, None], lambda at, own: own[0] @ at + own[1], known
    )
    return np.stack(stages), np.stack(end, axis=1)


def _second_order(
    tensor: Array, stages: _Stages, forces: ForceModel, forced: _Forced | None = None
) -> Array:
    """Second derivatives (n, 2, 3, 36) of the step's end from those of its start.

    The stages' accelerations have a_i'' = H_i (r_i', r_i') + G_i r_i''. With p parameters w besides,
    those by w and state follow, (n, 2, 3, 6 (6 + p)), with H_i (dr_i/dw, r_i') + (dG_i/dw) r_i' + ...
    """
    n = len(tensor)
    first = stages.first.reshape(4 * n, 3, 6)
    moment = _moment(forces, stages.time, stages.time.shape)
    curvature = gravity_curvature(stages.position.reshape(-1, 3), forces, moment)
    # Columns (i, k) of H_lim r_mk and then of r_lj H_lim r_mk, as H is symmetric.
    along = (curvature.reshape(-1, 9, 3) @ first).reshape(-1, 3, 18)
    rows = first
    if forced is not None:
        rows = np.concatenate([first, forced.first.reshape(4 * n, 3, -1)], axis=2)
    both = (rows.transpose(0, 2, 1) @ along).reshape(4, n, -1, 3, 6)
    if forced is not None:
        both[:, :, 6:] += forced.slope @ stages.first[:, :, None]
    bend = both.transpose(0, 1, 3, 2, 4).reshape(4, n, 3, -1)
    w, known = stages.h[:, None, None], zip(bend, stages.gradient, strict=True)
    _, *end = runge_kutta(
        tensor[:, 0], tensor[:, 1], w, lambda at, own: own[0] + own[1] @ at, known
    )
    return np.stack(end, axis=1)
