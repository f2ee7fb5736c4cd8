"""Transcribe P3 and P2 into nonlinear programs by multiple or single shooting.

In multiple shooting the unknowns are the burns and, node by node, y_k = (mean, entries of the
spread), after the burn if one falls on the node. An arc maps the leading part of y_k that its end
still needs to the leading part of y_{k+1}. A burn adds its own entries there. In single shooting
only the burns are unknowns, and the y_k are rolled out from the burns.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace

import casadi as ca
import numpy as np

from formulations.arrays import Array, Indices
from formulations.nlp.covariance import GUARD, Covariance, own_covariance, root, shared_columns
from formulations.nlp.program import (
    Arcs,
    Mapped,
    NlpRows,
    Program,
    Start,
    burn_blocks,
    deviations,
    final_state_block,
    norms,
    state_blocks,
)
from formulations.problem.controls import UNIT
from formulations.problem.facets import Facets
from formulations.problem.flyby import NO_TIMES, FlybyProblem
from formulations.rows.cones import PARTS

WAVES = 8
"""Waves of a home orbit by phase, with the mean: a circle has one, its states' squares two."""


@dataclass(frozen=True)
class MultipleShooting:
    """A transcription; see `program.Transcription`.

    Attributes:
        printed: as the paper prints it: all entries of the covariance, carried to the last node; cones
            by ratios, unless violations are weighed; and one call per arc. Else the unique entries,
            carried to the last node with a facet; cones by distances; and one map over all arcs, whose
            derivatives of both orders are formed arc by arc, not by CasADi's sweeps through the whole.
    """

    printed: bool

    def __call__(
        self, problem: FlybyProblem, arcs: Arcs, facets: Facets | None, start: Start, elastic: bool
    ) -> Program:
        """Write the program down."""
        # Without a facet there is nothing to spread for.
        uncertain = facets is not None and len(facets.node)
        spread = Covariance(problem, printed=self.printed) if uncertain else None
        layout = _layout(problem, spread, None if facets is None or self.printed else facets.node)
        x = ca.MX.sym("x", layout.total)
        burns = ca.reshape(x[: 3 * problem.n_burns], 3, problem.n_burns)
        node = [x[int(o) : int(o + s)] for o, s in zip(layout.start, layout.size, strict=True)]
        mean = ca.horzcat(*(y[:6] for y in node))
        groups = [_Group(layout, arcs, spread, first, last) for first, last in layout.groups()]
        ends = _stack(layout, groups, x, mapped=not self.printed)
        smooth = _burn_part(problem, spread, layout, burns) - x[3 * problem.n_burns :]
        own = None
        if self.printed:
            smooth += ends
        else:
            own = _differentiated(layout, groups, x, ends)
        deviation = None
        if spread is not None and facets is not None:
            deviation = deviations(spread, facets, node)
        printed = self.printed and not elastic
        blocks = (
            NlpRows("arcs", smooth, weight=0.0, equality=True),
            final_state_block(problem, mean),
            *burn_blocks(problem, burns, printed=printed),
            *state_blocks(problem, facets, mean, deviation, printed=printed),
        )
        point = _pack(spread, layout, start)
        return Program(x, point, burns, mean, ca.sum2(norms(burns)), blocks, own)


@dataclass(frozen=True)
class _Layout:
    """Places of the y_k among the unknowns.

    Attributes:
        start: index of its first component, shape (n_nodes,); the rows of the block `arcs` have the
            same order, less the burns.
        size: of y_k, shape (n_nodes,).
        carried: components that arc k maps, shape (n_nodes - 1,).
    """

    start: Indices
    size: Indices
    carried: Indices

    @property
    def total(self) -> int:
        """Number of unknowns."""
        return int(self.start[-1] + self.size[-1])

    @property
    def row(self) -> Indices:
        """First row of each node in the block `arcs`."""
        return self.start - self.start[0]

    def groups(self) -> Iterator[tuple[int, int]]:
        """Runs of arcs of one size: first and one past the last."""
        for _, run in itertools.groupby(range(len(self.carried)), lambda k: self.carried[k]):
            arcs = list(run)
            yield arcs[0], arcs[-1] + 1


def _layout(problem: FlybyProblem, spread: Covariance | None, looked_at: Indices | None) -> _Layout:
    last = problem.n_nodes - 1 if looked_at is None else int(looked_at.max(initial=0))
    size = 6 + np.where(np.arange(problem.n_nodes) <= last, spread.size if spread else 0, 0)
    carried = np.where(np.arange(1, problem.n_nodes) <= last, size[:-1], 6)
    return _Layout(3 * problem.n_burns + np.cumsum(size) - size, size, carried)


def _arc_symbol(arcs: Arcs) -> ca.SX:
    return ca.SX.sym("h", arcs.flow.size1_in(1))


class _Group:
    """Consecutive arcs of one size, as one SX function of y (s,) and h, and its derivatives."""

    def __init__(
        self, layout: _Layout, arcs: Arcs, spread: Covariance | None, first: int, last: int
    ) -> None:
        self.count = last - first
        self.size = int(layout.carried[first])
        self.start, self.row = layout.start[first:last], layout.row[first + 1 : last + 1]
        self._durations = ca.DM(arcs.durations[first:last]).T
        self._y, self._h = ca.SX.sym("y", self.size), _arc_symbol(arcs)
        self._end = step(arcs, spread, self._y, self._h)
        self._function = ca.Function("arc", [self._y, self._h], [self._end])

    def inputs(self, x: ca.MX) -> ca.MX:
        """The y of every arc, shape (s, n)."""
        index = self.start[:, None] + np.arange(self.size)
        return ca.reshape(x[index.ravel().tolist()], self.size, self.count)

    def value(self, x: ca.MX, *, mapped: bool) -> ca.MX:
        """Ends of the arcs one after the other, shape (s n,)."""
        inputs, durations = self.inputs(x), self._durations
        if mapped:
            return ca.vec(self._function.map(self.count)(inputs, durations))
        ends = (self._function(inputs[:, j], durations[:, j]) for j in range(self.count))
        return ca.vertcat(*ends)

    def jacobian(self, x: ca.MX, rows: int) -> ca.MX:
        """Jacobian of the value, each arc's block in its place among `rows` rows."""
        first = ca.jacobian(self._end, self._y)
        function = ca.Function("jacobian", [self._y, self._h], [first])
        blocks = function.map(self.count)(self.inputs(x), self._durations)
        return self._placed(blocks, function.sparsity_out(0), self.row, rows, x.numel())

    def hessian(self, x: ca.MX, multipliers: ca.MX) -> ca.MX:
        """Upper triangle, each arc's block in its place among the unknowns."""
        factor = ca.SX.sym("lambda", self.size)
        second = ca.triu(ca.hessian(ca.dot(factor, self._end), self._y)[0])
        function = ca.Function("hessian", [self._y, self._h, factor], [second])
        own = (self.row[:, None] + np.arange(self.size)).ravel().tolist()
        factors = ca.reshape(multipliers[own], self.size, self.count)
        blocks = function.map(self.count)(self.inputs(x), self._durations, factors)
        return self._placed(blocks, function.sparsity_out(0), self.start, x.numel(), x.numel())

    def _placed(
        self, blocks: ca.MX, pattern: ca.Sparsity, row: Indices, rows: int, columns: int
    ) -> ca.MX:
        # Blocks follow each other downwards and to the right, so that the nonzeros of all of them,
        # column by column, are in order already.
        i, j = (np.array(index, dtype=np.intp) for index in pattern.get_triplet())
        place = [(offset[:, None] + index).ravel() for offset, index in ((row, i), (self.start, j))]
        sparsity = ca.Sparsity.triplet(rows, columns, *(index.tolist() for index in place))
        return ca.MX(sparsity, blocks.nz[:])


def step(arcs: Arcs, spread: Covariance | None, y: ca.SX, duration: ca.SX) -> ca.SX:
    """End of an arc: flow map of the mean and the carried spread of y = (mean, entries)."""
    mean, entries = y[:6], y[6:]
    end = arcs.flow(mean, duration)
    if spread is None or not entries.numel():
        return end
    return ca.vertcat(end, spread.carry(ca.jacobian(end, mean), entries))


def _stack(layout: _Layout, groups: list[_Group], x: ca.MX, *, mapped: bool) -> ca.MX:
    """Ends of all arcs, in the rows of the nodes that they lead to."""
    parts, row = [], 0
    for group in groups:
        parts += [ca.MX(int(group.row[0]) - row, 1), group.value(x, mapped=mapped)]
        row = int(group.row[0]) + group.size * group.count
    return ca.vertcat(*parts, ca.MX(layout.total - int(layout.start[0]) - row, 1))


def _differentiated(layout: _Layout, groups: list[_Group], x: ca.MX, ends: ca.MX) -> Mapped:
    rows = layout.total - int(layout.start[0])
    jacobian = sum((group.jacobian(x, rows) for group in groups), ca.MX(rows, x.numel()))

    def hessian(multipliers: ca.MX) -> ca.MX:
        parts = (group.hessian(x, multipliers) for group in groups)
        return sum(parts, ca.MX(x.numel(), x.numel()))

    return Mapped(ends, jacobian, hessian)


def _burn_part(
    problem: FlybyProblem, spread: Covariance | None, layout: _Layout, burns: ca.MX
) -> ca.MX:
    """Initial data and additions of the burns, in the rows of their nodes."""
    parts = [ca.MX(int(size), 1) for size in layout.size]
    for i, k in enumerate(problem.burn_nodes):
        parts[k] = ca.vertcat(ca.MX(3, 1), burns[:, i])
        if spread is not None and layout.size[k] > 6:
            parts[k] = ca.vertcat(parts[k], spread.kick(burns[:, i]))
    given = np.zeros(layout.size[0])
    given[:6] = problem.initial_state
    if spread is not None:
        given[6:] = spread.pack(problem.first_factor)
    parts[0] += given
    return ca.vertcat(*parts)


def _pack(spread: Covariance | None, layout: _Layout, start: Start) -> Array:
    """Values of the unknowns at an iterate and its factor."""
    parts = [start.iterate.burns.ravel()]
    for k, mean in enumerate(start.iterate.mean):
        parts.append(mean)
        if spread is not None and layout.size[k] > 6:
            if start.factor is None:
                raise ValueError("P2 needs a start with a covariance factor")
            parts.append(spread.pack(start.factor[k]))
    return np.concatenate(parts)


@dataclass(frozen=True)
class SingleShooting:
    """A transcription; see `program.Transcription`. It starts from the guess's burns alone.

    Arcs carry the mean and the STM from the last burn, from which covariances follow. Burns that are
    held are no unknowns: their sizes have no derivative. Firing times are unknowns where they are
    controls, and the arcs' durations follow them.
    """

    def __call__(
        self, problem: FlybyProblem, arcs: Arcs, facets: Facets | None, start: Start, elastic: bool
    ) -> Program:
        """Write the program down."""
        del elastic  # every row is a signed distance in any case
        free = np.setdiff1d(np.arange(problem.n_burns), problem.held)
        moving = problem.firing_times(start.iterate.times)
        own, n = ca.MX.sym("x", 3 * len(free) + len(moving)), 3 * len(free)
        burns, times = ca.MX(3, problem.n_burns), UNIT * own[n:]
        burns[:, free.tolist()] = ca.reshape(own[:n], 3, len(free))
        last = last_spread_node(problem, facets)
        first, covariance, goal = boundary_of(problem, times)
        node, stm = roll_out(problem, arcs, last, burns, first, times)
        mean = ca.horzcat(*node)
        covariances = _covariances(problem, burns, stm, last, covariance)
        blocks = (
            final_state_block(problem, mean, goal),
            *burn_blocks(replace(problem, held=()), burns, printed=False),
            *spread_blocks(problem, facets, mean, covariances, stm),
        )
        if (firing := problem.firing) is not None:
            slack = ca.DM(firing.matrix) @ times - ca.DM(firing.least)
            blocks = (*blocks, NlpRows("firing_times", slack, weight=0.0))
        point = np.r_[start.iterate.burns[free].ravel(), moving / UNIT]
        return Program(own, point, burns, mean, ca.sum2(norms(burns)), blocks, times=times)


def last_spread_node(problem: FlybyProblem, facets: Facets | None) -> int:
    """Last node whose covariance the rows of a program need; -1 if none."""
    if facets is None:
        return -1
    limited = problem.final_spread != (None, None)
    return problem.n_nodes - 1 if limited else int(facets.node.max(initial=-1))


def spread_blocks(
    problem: FlybyProblem,
    facets: Facets | None,
    mean: ca.MX,
    covariances: list[ca.MX],
    stm: list[ca.MX],
) -> Iterator[NlpRows]:
    """State constraints on the means (6, n_nodes), and limits on the final covariance.

    The covariances (6 + p, 6 + p) are those at the starts of the legs, from where the STMs (6, 6 + p)
    lead.
    """
    deviation = None
    if facets is not None and len(facets.node):
        deviation = _deviations(problem, facets, mean, covariances, stm)
    yield from state_blocks(problem, facets, mean, deviation, printed=False)
    if facets is not None:
        for (name, part), limit in zip(PARTS, problem.final_spread, strict=True):
            if limit is not None:
                yield NlpRows(name, limit - root(ca.trace(covariances[-1][part, part])))


def boundary_of(problem: FlybyProblem, times: ca.MX | None) -> tuple[ca.MX, ca.MX, ca.MX]:
    """State (6,) and covariance (6 + p, 6 + p) before the first burn, and the final state (6,).

    Where phases are controls they are by these, as `periodic` has them.
    """
    first, last = ca.MX(ca.DM(problem.initial_state)), ca.MX(ca.DM(problem.final_state))
    covariance = ca.MX(ca.DM(problem.initial_factor @ problem.initial_factor.T))
    firing = problem.firing
    if times is None or firing is None or (boundary := firing.boundary) is None:
        return first, covariance, last
    phase = dict(zip(boundary.free, ca.vertsplit(times[len(firing.burns) :]), strict=True))

    def begin(angle: float) -> Array:
        state, factor = boundary.first(angle)
        return np.r_[state, (factor @ factor.T).ravel()]

    if 0 in phase:
        both = periodic(begin, phase[0])
        first, covariance = both[:6], ca.reshape(both[6:], *covariance.shape)
    return first, covariance, periodic(boundary.last, phase[1]) if 1 in phase else last


def periodic(of: Callable[[float], Array], phase: ca.MX) -> ca.MX:
    """A function (k,) of a phase by its first `WAVES` - 1 waves: exact for a circular orbit."""
    angles = np.pi / WAVES * np.arange(2 * WAVES)
    waves = np.fft.rfft([of(angle) for angle in angles.tolist()], axis=0)[:WAVES].T / len(angles)
    turns = ca.DM(np.arange(1, WAVES)) * phase
    cosines, sines = 2.0 * waves[:, 1:].real, 2.0 * waves[:, 1:].imag
    return ca.DM(waves[:, 0].real) + ca.DM(cosines) @ ca.cos(turns) - ca.DM(sines) @ ca.sin(turns)


def _covariances(
    problem: FlybyProblem, burns: ca.MX, stm: list[ca.MX], last: int, first: ca.MX
) -> list[ca.MX]:
    """Covariances of deviation and p parameters at starts of the legs that begin at nodes up to `last`.

    Shape (6 + p, 6 + p) each, from the `first` before any burn. Errors that all burns share stand
    below; see `roll_out` for the STMs.
    """
    errors, starts, size = problem.execution_errors, problem.leg_starts, 6 + problem.parameters
    covariance, found = ca.MX(np.eye(size + errors.shared)), []
    covariance[:size, :size] = first
    for leg, node in enumerate(starts[starts <= last].tolist()):
        if leg > 0:
            constant = ca.MX(np.eye(size)[6:])
            flown = ca.diagcat(ca.vertcat(stm[node], constant), ca.MX(np.eye(errors.shared)))
            covariance = flown @ covariance @ flown.T
        if (burn := leg - problem.coasts) >= 0:
            kick = ca.MX(np.eye(size + errors.shared))
            kick[3:6, size:] = shared_columns(errors, burns[:, burn])
            covariance = kick @ covariance @ kick.T
            covariance[3:6, 3:6] += own_covariance(errors, burns[:, burn])
        found.append(covariance[:size, :size])
    return found


def roll_out(
    problem: FlybyProblem,
    arcs: Arcs,
    last: int,
    burns: ca.MX,
    state: ca.MX,
    times: ca.MX | None = None,
) -> tuple[list[ca.MX], list[ca.MX]]:
    """Means (6,) of every node after its burn, and STMs (6, 6 + p) to nodes up to `last`.

    From a state (6,) before the first burn; STMs by state and parameters, from the start of the leg
    that ends or passes there. Firing times (q,) are those of the problem's burns that move; the grid's
    if there are none.
    """
    durations = _durations(problem, arcs, times)
    burn_at = dict(zip(problem.burn_nodes.tolist(), range(problem.n_burns), strict=True))
    kicks = ca.vertcat(ca.MX(3, problem.n_burns), burns)
    still = ca.MX(np.eye(6, 6 + problem.parameters))
    mean, stm = [state], [still]
    if not problem.coasts:
        mean[0] += kicks[:, 0]
    for first, end in itertools.pairwise(sorted({0, *burn_at, max(last, 0)})):
        y = ca.vertcat(mean[-1], ca.vec(still)) if end <= last else mean[-1]
        ends = _fly(arcs, y, durations[:, first:end])
        mean += ca.horzsplit(ends[:6, :])
        if end <= last:
            stm += [ca.reshape(entries, *still.shape) for entries in ca.horzsplit(ends[6:, :])]
        if end in burn_at:
            mean[-1] += kicks[:, burn_at[end]]
    return mean, stm


def _deviations(
    problem: FlybyProblem, facets: Facets, mean: ca.MX, starts: list[ca.MX], stm: list[ca.MX]
) -> ca.MX:
    """Standard deviations along the facets' normals, (m,), from the covariances at the legs' starts.

    Of positions as they are seen from regions that move with p parameters: see `regions.Motion`.
    """
    leg, p = np.searchsorted(problem.leg_starts, facets.node), problem.parameters
    begun = problem.leg_starts[leg] == facets.node
    still = ca.MX(np.eye(6, 6 + p))
    flown = [still if new else stm[k] for k, new in zip(facets.node, begun, strict=True)]
    covariances = [starts[i] for i in (leg - ~begun).tolist()]
    a, there = ca.SX.sym("a", 3), ca.SX.sym("stm", 3, 6 + p)
    before, seen = ca.SX.sym("covariance", 6 + p, 6 + p), ca.SX.sym("seen", 3, p)
    pulled = (there + ca.horzcat(ca.SX(3, 6), seen)).T @ a
    size = ca.sqrt(pulled.T @ before @ pulled + GUARD)
    each = ca.Function("deviation", [a, there, before, seen], [size]).map(len(leg))
    given = ca.horzcat(*(one[:3, :] for one in flown)), ca.horzcat(*covariances)
    return each(ca.DM(facets.normal.T), *given, _seen(facets, mean, p)).T


def _seen(facets: Facets, mean: ca.MX, p: int) -> ca.MX:
    """`Motion.seen` at every facet's mean, side by side, shape (3, p m)."""
    motion = facets.motion
    if motion is None:
        return ca.MX(3, p * len(facets.node))
    found = []
    for k, node in enumerate(facets.node.tolist()):
        off = mean[:3, node] - ca.DM(motion.apex[k])
        found.append(-ca.DM(motion.shift[k]) + ca.skew(off) @ ca.DM(motion.turn[k]))
    return ca.horzcat(*found)


def _durations(problem: FlybyProblem, arcs: Arcs, times: ca.MX | None) -> ca.MX:
    """Each arc's h, shape (k, n).

    Raises:
        ValueError: if arcs move whose forces depend on time.
    """
    firing = problem.firing
    if firing is None or times is None:
        return ca.MX(ca.DM(arcs.durations).T)
    if arcs.durations.shape[1] > 1:
        raise ValueError("IPOPT's firing times are free only where forces do not depend on time")
    moved = times - ca.DM(problem.firing_times(NO_TIMES))
    nodes = ca.DM(firing.nodes) + ca.DM(firing.shares) @ moved
    return ca.diff(nodes).T


def _fly(arcs: Arcs, y: ca.MX, durations: ca.MX) -> ca.MX:
    """Mean and, if y has it, STM at the ends of arcs one after the other, (s, n)."""
    symbol, h = ca.SX.sym("y", y.numel()), _arc_symbol(arcs)
    after = arcs.flow(symbol[:6], h)
    if y.numel() > 6:
        stm = ca.jacobian(after, symbol[:6]) @ ca.reshape(symbol[6:], 6, y.numel() // 6 - 1)
        if arcs.by_parameters is not None:
            stm[:, 6:] += arcs.by_parameters(symbol[:6], h)
        after = ca.vertcat(after, ca.vec(stm))
    function = ca.Function("arc", [symbol, h], [after])
    return function.mapaccum(durations.shape[1])(y, durations)
