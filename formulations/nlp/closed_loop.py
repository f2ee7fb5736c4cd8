"""Corrected burns over CasADi's symbols: the factor along the legs, the cost, limits on the burns.

What `linearisation.factor` and `problem.cost` say is written once more, for CasADi to differentiate;
`shooting.SingleShooting` puts it together.
"""

from __future__ import annotations

import itertools
from collections.abc import Mapping, Sequence
from functools import lru_cache
from typing import Any, NamedTuple, TypeVar

import casadi as ca
import numpy as np

from formulations.arrays import Array
from formulations.linearisation.factor import corrected, measured_in
from formulations.nlp.covariance import correction_columns, own_columns, root, shared_columns
from formulations.nlp.program import NlpRows, norms
from formulations.problem.cost import DRAWS, PROBABILITY, QUANTILE, SMALLEST, SMOOTH
from formulations.problem.flyby import FlybyProblem
from formulations.risk.directions import normal_points
from formulations.rows.corrected_burns import certain_part, margins_of

T = TypeVar("T", ca.MX, ca.DM)


def gains_of(problem: FlybyProblem, unknowns: T) -> list[T]:
    """Gains (3, 6 (j + 1)) of each corrected burn j, from all of them in one vector."""
    feedback = problem.feedback
    if feedback is None:
        return []
    ends = feedback.first_gain.tolist()
    parts = (unknowns[first:stop] for first, stop in itertools.pairwise(ends))
    return [ca.reshape(part, part.numel() // 3, 3).T for part in parts]


def factors(
    problem: FlybyProblem,
    burns: ca.MX,
    gains: Sequence[ca.MX],
    stm: Sequence[ca.MX],
    last: int,
) -> list[ca.MX]:
    """The factor S (6, c) at the start of each leg that begins at a node up to `last`.

    Args:
        problem: its measurements and errors.
        burns: shape (3, m).
        gains: of each corrected burn.
        stm: to each node up to `last`, from the start of the leg that ends or passes there, (6, 6).
        last: node.
    """
    count, starts, feedback = problem.factor_columns, problem.leg_starts, problem.feedback
    first = np.pad(problem.first_factor, ((0, 0), (0, count - problem.first_factor.shape[1])))
    spread = error = ca.MX(ca.sparsify(ca.DM(first)))
    found: list[ca.MX] = []
    innovations: list[ca.MX] = []

    def measure(error: ca.MX, leg: int) -> ca.MX:
        for j in measured_in(problem, leg):
            assert feedback is not None
            node, (_, own) = int(feedback.cut_offs[j]), problem.columns_of_correction(j)
            if node > last:
                break
            there = stm[node] @ error if leg >= 0 else error
            noise = ca.MX(ca.DM(feedback.measurement[j]))
            measured = there + _placed(6, count, [(own, noise)])
            innovations.append(_whitening(measured @ measured.T) @ measured)
            error = error - (error @ innovations[-1].T) @ innovations[-1]
        return error

    error = measure(error, -1)
    for leg, node in enumerate(starts[starts <= last].tolist()):
        if leg > 0:
            spread, error = stm[node] @ spread, stm[node] @ error
        burn = leg - problem.coasts
        if burn >= 0:
            j = corrected(problem, burn)
            executed = _errors(problem, burns[:, burn], burn, None if j is None else gains[j])
            spread, error = spread + executed, error + executed
            if j is not None:
                correction = gains[j] @ ca.vertcat(*innovations[: j + 1])
                spread = spread + ca.vertcat(ca.MX(3, count), correction)
        found.append(spread)
        error = measure(error, leg)
    return found


def _errors(problem: FlybyProblem, size: ca.MX, burn: int, gains: ca.MX | None) -> ca.MX:
    """What executing a burn (3,) and its correction adds to a factor, shape (6, c)."""
    errors, j = problem.execution_errors, corrected(problem, burn)
    parts = [
        (problem.shared_columns, shared_columns(errors, size)),
        (problem.columns_of_burn(burn), own_columns(errors, size)),
    ]
    if j is not None and gains is not None:
        parts.append((problem.columns_of_correction(j)[0], correction_columns(errors, gains)))
    kick = _placed(3, problem.factor_columns, parts)
    return ca.vertcat(ca.MX(3, problem.factor_columns), kick)


def _placed(rows: int, count: int, parts: Sequence[tuple[slice, ca.MX]]) -> ca.MX:
    """Columns in their places among `count`, ascending; the others are structurally zero."""
    pieces, at = [], 0
    for place, part in parts:
        pieces += [ca.MX(rows, place.start - at), part]
        at = place.stop
    return ca.horzcat(*pieces, ca.MX(rows, count - at))


def _whitening(covariance: ca.MX) -> ca.MX:
    """W^-1 of the triangular root W of a covariance (6, 6)."""
    a = ca.SX.sym("a", 6, 6)
    inverse = ca.solve(ca.chol(a).T, ca.SX.eye(6))
    return ca.Function("whitening", [a], [inverse])(covariance)


class Policy(NamedTuple):
    """What the burns and gains of a program are worth.

    Attributes:
        cost: what is minimised, as `problem.cost` counts it.
        blocks: limits on corrected burns, and what defines the further unknowns.
        unknowns: further ones, of which all may be bounded below by zero.
        start: their initial values.
        kept: what evaluates the limits.
    """

    cost: ca.MX
    blocks: list[NlpRows]
    unknowns: ca.MX
    start: Array
    kept: tuple[ca.Callback, ...] = ()


def policy(
    problem: FlybyProblem, burns: ca.MX, gains: Sequence[ca.MX], first: tuple[Array, Array]
) -> Policy:
    """Of burns (3, m) and each corrected burn's gains, and where these start, as arrays.

    A size that is charged alone has a kink where it vanishes, which Newton's method hardly comes to.
    It is an unknown t with t - v'v / t >= 0, a second-order cone. The quantile's distance from the
    mean, in standard deviations, is another, with an equation. Limits are quantiles without a
    formula: the convex program's own margins with their gradients; second derivatives are differences.
    """
    feedback = problem.feedback
    if feedback is None:
        return Policy(ca.sum2(norms(burns)), [], ca.MX(0, 1), np.zeros(0))
    limits = tuple(_Limits(problem, burn) for burn in feedback.burns.tolist())
    laws = zip(ca.horzsplit(burns[:, feedback.burns.tolist()]), gains, strict=True)
    given = (ca.vertcat(mean, ca.vec(own @ own.T)) for mean, own in laws)
    margins = [each(numbers) for each, numbers in zip(limits, given, strict=True)]
    rows = ca.vertsplit(ca.vec(ca.horzcat(*margins).T), len(limits))
    charged = _charged(problem, burns, gains)
    sizes, tail = ca.MX.sym("sizes", len(charged)), ca.MX.sym("tail", feedback.cost == "dv99")
    own = ca.vertcat(*(ca.sumsqr(vector) for _, vector in charged))
    blocks = [
        *map(NlpRows, limits[0].names, rows),
        NlpRows("sizes", sizes - own / sizes, weight=0.0),
    ]
    cost = ca.dot(sizes, ca.DM([price for price, _ in charged]))
    if feedback.cost != "nominal":
        commanded = _commanded(problem, burns, gains)
        mean = ca.sum2(commanded) / DRAWS
        off = commanded - mean
        width = root(ca.sumsqr(off) / DRAWS)
        cost += mean
    if feedback.cost == "dv99":
        beyond = (tail - off / width / np.sqrt(1.0 + SMOOTH**2)) / SMOOTH
        share = ca.sum2(0.5 + 0.5 * ca.erf(beyond / np.sqrt(2.0))) / DRAWS
        blocks.append(NlpRows("quantile", share - PROBABILITY, weight=0.0, equality=True))
        cost += tail * width
    there = _charged(problem, ca.DM(first[0].T), gains_of(problem, ca.DM(first[1])))
    start = [2.0 * float(ca.norm_2(vector)) + SMALL * problem.dv_max for _, vector in there]
    start += [QUANTILE] * tail.numel()
    return Policy(cost, blocks, ca.vertcat(sizes, tail), np.array(start), limits)


def _charged(problem: FlybyProblem, burns: T, gains: Sequence[T]) -> list[tuple[float, T]]:
    """Vectors whose sizes are charged alone, with their prices; none that is held."""
    feedback, free = problem.feedback, np.setdiff1d(np.arange(problem.n_burns), problem.held)
    assert feedback is not None
    nominal = feedback.cost == "nominal"
    alone = free if nominal else np.setdiff1d(free, feedback.burns)
    corrections = zip(feedback.burns, gains, strict=True)
    return [(1.0, burns[:, burn]) for burn in alone.tolist()] + [
        (SMALLEST, ca.vec(own)) for burn, own in corrections if nominal and burn in free
    ]


def _commanded(problem: FlybyProblem, burns: ca.MX, gains: Sequence[ca.MX]) -> ca.MX:
    """The sum of the corrected burns' sizes at every draw of `problem.cost`, a row."""
    assert problem.feedback is not None
    corrected = problem.feedback.burns.tolist()
    draws, total = normal_points(DRAWS, 6 * len(corrected)).T, ca.MX(1, DRAWS)
    for burn, own in zip(corrected, gains, strict=True):
        correction = own @ ca.DM(draws[: own.shape[1]])
        total += norms(correction + ca.repmat(burns[:, burn], 1, DRAWS))
    return total


SMALL = 1e-2
"""Over the largest burn: gains on the velocity just measured from which planning starts where all would
be zero. There the cost has a kink."""


def first_gains(problem: FlybyProblem, gains: Array) -> Array:
    """Gains to start from: those of an iterate, unless they are zero."""
    feedback = problem.feedback
    if feedback is None or gains.any():
        return gains
    own = [np.zeros((3, 6 * (j + 1))) for j in range(len(feedback.burns))]
    for one in own:
        one[:, -3:] = SMALL * problem.dv_max * np.eye(3)
    return np.concatenate([one.ravel() for one in own])


STEP = 1e-5
"""Of the differences of the limits' gradients, over the largest burn, and over its square."""


class _Limits(ca.Callback):
    """Margins of one corrected burn by its components and its correction's covariance.

    The law of the commanded burn is that of these twelve numbers. With further inputs, which CasADi
    gives and nobody needs, it is their Jacobian; and that of this one, by central differences.
    """

    def __init__(
        self,
        problem: FlybyProblem,
        burn: int,
        name: str = "limits",
        inputs: Sequence[str] = ("x",),
        outputs: Sequence[str] = ("margins",),
        options: Mapping[str, Any] | None = None,
    ) -> None:
        ca.Callback.__init__(self)
        self._problem, self._burn, self._inputs, self._outputs = problem, burn, inputs, outputs
        self.names = _margins(problem, burn, np.zeros(12).tobytes())[0]
        self.construct(name, dict(options or {}))

    def get_n_in(self) -> int:
        """See `casadi.Callback`."""
        return len(self._inputs)

    def get_n_out(self) -> int:
        """See `casadi.Callback`."""
        return len(self._outputs)

    def get_name_in(self, i: int) -> str:
        """As CasADi asks for them."""
        return self._inputs[i]

    def get_name_out(self, i: int) -> str:
        """As CasADi asks for them."""
        return self._outputs[i]

    def get_sparsity_in(self, i: int) -> ca.Sparsity:
        """The numbers; margins; their Jacobian."""
        return ca.Sparsity.dense(*((12, 1), (len(self.names), 1), (len(self.names), 12))[i])

    def get_sparsity_out(self, i: int) -> ca.Sparsity:
        """Derivatives by the numbers; those of the Jacobian by the margins are none."""
        rows = len(self.names) * (12 if len(self._inputs) == 3 else 1)
        if i > 0:
            return ca.Sparsity(rows, len(self.names))
        return ca.Sparsity.dense(rows, 1 if len(self._inputs) == 1 else 12)

    def has_jacobian(self) -> bool:
        """Up to the second derivatives."""
        return len(self._inputs) < 3

    def get_jacobian(
        self, name: str, inputs: Sequence[str], outputs: Sequence[str], options: Mapping[str, Any]
    ) -> ca.Function:
        """See `casadi.Callback`."""
        self._jacobian = _Limits(self._problem, self._burn, name, inputs, outputs, options)
        return self._jacobian

    def eval(self, arguments: Sequence[ca.DM]) -> list[ca.DM]:
        """See `casadi.Callback`."""
        at = np.array(arguments[0]).ravel()
        if len(self._inputs) < 3:
            _, value, slope = _margins(self._problem, self._burn, at.tobytes())
            return [ca.DM(value[:, 0] if len(self._inputs) == 1 else slope[:, 0])]
        largest = self._problem.dv_max
        size = STEP * np.repeat([largest, largest**2], [3, 9])
        points = np.vstack([at + np.diag(size), at - np.diag(size)])
        _, _, slope = _margins(self._problem, self._burn, points.tobytes())
        ahead, behind = np.split(slope, 2, axis=1)
        second = (ahead - behind) / (2.0 * size[:, None])
        # Rows are the Jacobian's entries, column by column.
        by_entry = second.transpose(2, 0, 1).reshape(-1, 12)
        return [ca.DM(by_entry), ca.DM(len(by_entry), len(self.names))]


@lru_cache(maxsize=8)
def _margins(
    problem: FlybyProblem, burn: int, numbers: bytes
) -> tuple[tuple[str, ...], Array, Array]:
    """Names of the limits, margins (limits, n) and gradients (limits, n, 12), for numbers (n, 12)."""
    at = np.frombuffer(numbers).reshape(-1, 12)
    covariance = at[:, 3:].reshape(-1, 3, 3)
    values, vectors = np.linalg.eigh(0.5 * (covariance + covariance.swapaxes(1, 2)))
    gains = vectors * np.sqrt(np.maximum(values, 0.0))[:, None]
    found = margins_of(problem, np.full(len(at), burn), at[:, :3], gains)
    # With F F' a covariance, a function of it has the derivative 2 G F by F, whose last part is known.
    certain = 2.0 * certain_part(gains)[:, None, None]
    by_covariance = (one.by_factor[:, :, 3:] / certain for one in found.values())
    slopes = [
        np.hstack([one.by_mean, by.reshape(-1, 9)])
        for one, by in zip(found.values(), by_covariance, strict=True)
    ]
    return tuple(found), np.array([one.value for one in found.values()]), np.array(slopes)
