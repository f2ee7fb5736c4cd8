"""Plan corrected burns by IPOPT, written independently of the convex side, as an oracle for it.

The equations are those of `linearisation.factor`, `problem.cost` and `rows.corrected_burns`, in a
form that CasADi differentiates.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from typing import NamedTuple, TypeVar

import casadi as ca
import numpy as np
import scipy.sparse as sp

from formulations.arrays import Array
from formulations.linearisation.factor import corrected, measured_in
from formulations.nlp.covariance import own_covariance, shared_columns
from formulations.nlp.program import (
    Arcs,
    NlpRows,
    Program,
    Start,
    assemble,
    burn_blocks,
    final_state_block,
    norms,
)
from formulations.nlp.shooting import last_spread_node, roll_out, spread_blocks
from formulations.nlp.solve import FROM_NEAR, OUTCOMES, NlpOutcome, Settings, ipopt_solver
from formulations.problem.cost import DRAWS, PROBABILITY, QUANTILE, SMALLEST, SMOOTH, total_sizes
from formulations.problem.execution_errors import ComponentwiseErrors, ExecutionErrors, GatesErrors
from formulations.problem.facets import Facets
from formulations.problem.flyby import FlybyProblem, Iterate
from formulations.risk.lines import normal_points
from formulations.risk.quadratic_forms import NAPPE, WHOLE
from formulations.rows.corrected_burns import BATTERY, SIZE
from tests.oracles.probability import Limits, broken

T = TypeVar("T", ca.MX, ca.DM)


@dataclass(frozen=True)
class CorrectedProgram(Program):
    """A program whose burns are corrected.

    Attributes:
        gains: of corrected burns, as `Iterate` has them.
        bounded: number of the last unknowns that are not negative.
        kept: objects that must live as long as the program.
    """

    gains: ca.MX = field(default_factory=partial(ca.MX, 0, 1))
    bounded: int = 0
    kept: tuple[ca.Callback, ...] = ()

    def iterate(self, point: Array) -> Iterate:
        """Burns, means and gains at values of the unknowns."""
        found = super().iterate(point)
        gains = ca.Function("gains", [self.unknowns], [self.gains])(point)
        return Iterate(found.burns, found.mean, np.array(gains).ravel())


def corrected_shooting(
    problem: FlybyProblem, arcs: Arcs, facets: Facets | None, start: Start
) -> CorrectedProgram:
    """Single shooting in the burns and gains; it starts from those of the guess."""
    last, every = last_spread_node(problem, facets), problem.controls_before[-1]
    free = np.setdiff1d(np.arange(every), problem.controls_of(problem.held))
    first = start.iterate.burns, first_gains(problem, start.iterate.gains)
    own = ca.MX.sym("x", len(free))
    place = sp.csc_matrix(
        (np.ones(len(free)), (free, np.arange(len(free)))), shape=(every, len(free))
    )
    controls = ca.DM(place) @ own
    burns = ca.reshape(controls[problem.burn_controls.ravel().tolist()], 3, problem.n_burns)
    all_gains = controls[problem.gain_controls.tolist()]
    gains = gains_of(problem, all_gains)
    node, stm = roll_out(problem, arcs, last, burns, ca.MX(ca.DM(problem.initial_state)))
    mean = ca.horzcat(*node)
    law = policy(problem, burns, gains, first)
    blocks = (
        final_state_block(problem, mean),
        *burn_blocks(replace(problem, held=()), burns, printed=False),
        *spread_blocks(problem, facets, mean, covariances(problem, burns, gains, stm, last), stm),
        *law.blocks,
    )
    return CorrectedProgram(
        unknowns=ca.vertcat(own, law.unknowns),
        start=np.r_[problem.controls(*first)[free], law.start],
        burns=burns,
        mean=mean,
        cost=law.cost,
        blocks=blocks,
        gains=all_gains,
        bounded=len(law.start),
        kept=law.kept,
    )


def solve_corrected(
    problem: FlybyProblem,
    arcs: Arcs,
    facets: Facets | None,
    start: Start,
    settings: Settings = FROM_NEAR,
) -> tuple[Iterate, NlpOutcome]:
    """Solve P2 on fixed facets with corrected burns, or P3 without facets, by IPOPT."""
    program = corrected_shooting(problem, arcs, facets, start)
    nlp = assemble(program, None)
    nlp.lower[len(nlp.lower) - program.bounded :] = 0.0
    solver = ipopt_solver(nlp, settings)
    answer = solver(x0=nlp.start, lbx=nlp.lower, lbg=0.0, ubg=nlp.rows_upper)
    outcome = OUTCOMES.get(solver.stats()["return_status"], NlpOutcome.FAILED)
    return program.iterate(np.array(answer["x"]).ravel()), outcome


def correction_covariance(errors: ExecutionErrors, gains: ca.MX) -> ca.MX:
    """Covariance of a correction's errors by gains (3, n): see `ExecutionErrors.correction_columns`."""
    if isinstance(errors, GatesErrors):
        across = errors.pointing_proportional**2 * ca.sumsqr(gains) * ca.MX(np.eye(3))
        return across + errors.along_more**2 * gains @ gains.T
    assert isinstance(errors, ComponentwiseErrors)
    return ca.diag(errors.fraction**2 * ca.sum2(gains**2))


def gains_of(problem: FlybyProblem, unknowns: T) -> list[T]:
    """Gains (3, 6 (j + 1)) of each corrected burn j, from all of them in one vector."""
    feedback = problem.feedback
    if feedback is None:
        return []
    ends = feedback.first_gain.tolist()
    parts = (unknowns[first:stop] for first, stop in itertools.pairwise(ends))
    return [ca.reshape(part, part.numel() // 3, 3).T for part in parts]


def covariances(
    problem: FlybyProblem,
    burns: ca.MX,
    gains: Sequence[ca.MX],
    stm: Sequence[ca.MX],
    last: int,
) -> list[ca.MX]:
    """Covariances (6, 6) of the deviation at the start of each leg that begins at a node up to `last`.

    It is that of the estimate's error, P, by a Kalman filter, and that of the estimate sum M_j xi_j.
    States have six components and the errors that all burns share.

    Args:
        problem: its measurements and errors.
        burns: shape (3, m).
        gains: of each corrected burn.
        stm: to each node up to `last`, from the start of the leg that ends or passes there, (6, 6).
        last: node.
    """
    shared, starts, feedback = problem.execution_errors.shared, problem.leg_starts, problem.feedback
    first = np.eye(6 + shared)
    first[:6, :6] = problem.initial_factor @ problem.initial_factor.T
    error, known = ca.MX(ca.DM(first)), ca.MX(6 + shared, 0)
    found: list[ca.MX] = []

    def measure(error: ca.MX, known: ca.MX, leg: int) -> tuple[ca.MX, ca.MX]:
        for j in measured_in(problem, leg):
            assert feedback is not None
            if (node := int(feedback.cut_offs[j])) > last:
                break
            seen, noise = stm[node] @ error[:6, :], feedback.measurement[j]
            covariance = seen[:, :6] @ stm[node].T + noise @ noise.T
            gain = (_whitening(covariance) @ seen).T
            error, known = error - gain @ gain.T, ca.horzcat(known, gain)
        return error, known

    error, known = measure(error, known, -1)
    for leg, node in enumerate(starts[starts <= last].tolist()):
        if leg > 0:
            flown = ca.diagcat(stm[node], ca.MX(np.eye(shared)))
            error, known = flown @ error @ flown.T, flown @ known
        burn = leg - problem.coasts
        if burn >= 0:
            kick = ca.MX(np.eye(6 + shared))
            kick[3:6, 6:] = shared_columns(problem.execution_errors, burns[:, burn])
            error, known = kick @ error @ kick.T, kick @ known
            error[3:6, 3:6] += own_covariance(problem.execution_errors, burns[:, burn])
            if (j := corrected(problem, burn)) is not None:
                error[3:6, 3:6] += correction_covariance(problem.execution_errors, gains[j])
                known[3:6, : gains[j].shape[1]] += gains[j]
        found.append((known @ known.T + error)[:6, :6])
        error, known = measure(error, known, leg)
    return found


def _whitening(covariance: ca.MX) -> ca.MX:
    """W^-1 of the triangular root W of a covariance (6, 6)."""
    a = ca.SX.sym("a", 6, 6)
    inverse = ca.solve(ca.chol(a).T, ca.SX.eye(6))
    return ca.Function("whitening", [a], [inverse])(covariance)


class Policy(NamedTuple):
    """Cost and limits of the burns and gains of a program.

    Attributes:
        cost: what is minimised, as `problem.cost` counts it.
        blocks: limits on corrected burns, and what defines the further unknowns.
        unknowns: further ones, all positive.
        start: their initial values.
        kept: objects that evaluate the limits; they must outlive the program.
    """

    cost: ca.MX
    blocks: list[NlpRows]
    unknowns: ca.MX
    start: Array
    kept: tuple[ca.Callback, ...] = ()


LEAST = 1e-6
"""Price of an unknown size that costs nothing else, so that it is the size."""

FINE = 1e-4
"""Rounding of each draw's size where it vanishes, over the size t of a burn and its gains."""


def policy(
    problem: FlybyProblem, burns: ca.MX, gains: Sequence[ca.MX], first: tuple[Array, Array]
) -> Policy:
    """Cost and limits for burns (3, m) and each corrected burn's gains, with their start as arrays.

    The cost has a kink where a burn and its gains vanish, and Newton's method converges badly
    there. The joint size of both is therefore an unknown t with t - v'v / t >= 0, a second-order
    cone. The standard deviation of the total commanded delta-v is an unknown of the same kind. The
    distance of the quantile from the mean, in these standard deviations, is a further unknown with
    an equation.
    """
    feedback = problem.feedback
    if feedback is None:
        return Policy(ca.sum2(norms(burns)), [], ca.MX(0, 1), np.zeros(0))
    charged, dv99 = _charged(problem, burns, gains), feedback.cost == "dv99"
    sizes, more = ca.MX.sym("sizes", len(charged)), ca.MX.sym("more", 2 * dv99)
    own = ca.vertcat(*(ca.sumsqr(vector) for _, vector in charged))
    cost = ca.dot(sizes, ca.DM([price for price, _ in charged]))
    free = [j for j, burn in enumerate(feedback.burns) if burn not in problem.held]
    limits, kept = _limits(problem, burns, gains, free)
    blocks = [*limits, NlpRows("sizes", sizes - own / sizes, weight=0.0)]
    start = _first_sizes(problem, *first)
    if feedback.cost != "nominal":
        laws = sizes[sizes.numel() - len(free) :]
        commanded = _commanded(problem, burns, gains, free, laws)
        mean = ca.sum2(commanded) / DRAWS
        cost += mean
    if dv99:
        (width, tail), off = ca.vertsplit(more), commanded - mean
        beyond = (tail - off / width / np.sqrt(1.0 + SMOOTH**2)) / SMOOTH
        share = ca.sum2(0.5 + 0.5 * ca.erf(beyond / np.sqrt(2.0))) / DRAWS
        blocks += [
            NlpRows("width", width - ca.sumsqr(off) / DRAWS / width, weight=0.0),
            NlpRows("quantile", share - PROBABILITY, weight=0.0, equality=True),
        ]
        cost += tail * width
        there = Iterate(first[0], np.zeros((0, 6)), first[1])
        start = np.r_[start, _above(problem, float(total_sizes(problem, there).std())), QUANTILE]
    return Policy(cost, blocks, ca.vertcat(sizes, more), start, kept)


def _charged(problem: FlybyProblem, burns: T, gains: Sequence[T]) -> list[tuple[float, T]]:
    """Vectors whose sizes are unknowns, with their prices, those of corrected burns last; none held."""
    feedback, free = problem.feedback, np.setdiff1d(np.arange(problem.n_burns), problem.held)
    assert feedback is not None
    alone, nominal = np.setdiff1d(free, feedback.burns), feedback.cost == "nominal"
    charged = [(1.0, burns[:, burn]) for burn in alone.tolist()]
    laws = [
        (burns[:, int(burn)], ca.vec(own))
        for burn, own in zip(feedback.burns, gains, strict=True)
        if burn in free
    ]
    if nominal:
        return charged + [(1.0, v) for v, _ in laws] + [(SMALLEST, own) for _, own in laws]
    return charged + [(LEAST, ca.vertcat(v, own)) for v, own in laws]


def _first_sizes(problem: FlybyProblem, burns: Array, gains: Array) -> Array:
    """Sizes above those of some burns (m, 3) and gains."""
    there = _charged(problem, ca.DM(burns.T), gains_of(problem, ca.DM(gains)))
    return np.array([_above(problem, float(ca.norm_2(vector))) for _, vector in there])


NEAR = 1e-3
"""Share of a size, and of the largest burn, that the unknown for it starts above."""


def _above(problem: FlybyProblem, size: float) -> float:
    """A little above a size, within its cone."""
    return (1.0 + NEAR) * size + NEAR * problem.dv_max


def _commanded(
    problem: FlybyProblem, burns: ca.MX, gains: Sequence[ca.MX], free: list[int], sizes: ca.MX
) -> ca.MX:
    """The sum of the corrected burns' sizes at every draw of `problem.cost`, a row."""
    feedback = problem.feedback
    assert feedback is not None
    draws, total = normal_points(DRAWS, 6 * len(feedback.burns)).T, ca.MX(1, DRAWS)
    for j, size in zip(free, ca.vertsplit(sizes), strict=True):
        correction = gains[j] @ ca.DM(draws[: gains[j].shape[1]])
        burn = correction + ca.repmat(burns[:, int(feedback.burns[j])], 1, DRAWS)
        total += ca.sqrt(ca.sum1(burn**2) + (FINE * size) ** 2)
    return total


def _limits(
    problem: FlybyProblem, burns: ca.MX, gains: Sequence[ca.MX], free: list[int]
) -> tuple[list[NlpRows], tuple[ca.Callback, ...]]:
    """Limits of the corrected burns that are not held, and the objects that evaluate them.

    Rows are 1 - P(broken) / (1 - p): of the margins' sign, and without their kink where gains vanish.
    """
    feedback = problem.feedback
    assert feedback is not None
    if not free:
        return [], ()
    which, n = feedback.burns[free], len(free)
    certain = (CERTAIN * problem.dv_max) ** 2 * ca.MX(np.eye(3))
    covariance = ca.horzcat(*(ca.vec(gains[j] @ gains[j].T + certain) for j in free))
    ball = np.broadcast_to(np.eye(3), (n, 3, 3)), np.full(n, problem.dv_max**2)
    limits = {SIZE: Limits(*ball, 1.0, WHOLE)}
    if problem.dv_cone > 0.0:
        sun = problem.sun[which]
        nappes = np.cos(problem.dv_cone) ** 2 * np.eye(3) - sun[:, :, None] * sun[:, None]
        limits[BATTERY] = Limits(nappes, np.zeros(n), -1.0, NAPPE)
    rows, kept = [], []
    for name, limit in limits.items():
        chance, contours = broken(limit, burns[:, which.tolist()], covariance)
        row = 1.0 - chance.T / (1.0 - feedback.probability)
        rows.append(NlpRows(name, row, weight=0.0))
        kept.append(contours)
    return rows, tuple(kept)


CERTAIN = 1e-6
"""Standard deviation over the largest burn, added to each component of corrections: they may vanish."""

SMALL = 1e-2
"""Initial gains on the velocity just measured, over the largest burn, if all gains would be zero.
The cost has a kink at zero."""


def first_gains(problem: FlybyProblem, gains: Array) -> Array:
    """Initial gains: those of an iterate, unless they are zero."""
    feedback = problem.feedback
    if feedback is None or gains.any():
        return gains
    own = [np.zeros((3, 6 * (j + 1))) for j in range(len(feedback.burns))]
    for one in own:
        one[:, -3:] = SMALL * problem.dv_max * np.eye(3)
    return np.concatenate([one.ravel() for one in own])
