"""P3 and P2 with the burns alone as unknowns: mean and factor are rolled out of them."""

from __future__ import annotations

import itertools
from dataclasses import dataclass

import casadi as ca
import numpy as np

from formulations.nlp.covariance import Factor, initial_deviation
from formulations.nlp.multiple_shooting import kick, step
from formulations.nlp.program import Arcs, NlpRows, Program, Start
from formulations.nlp.rows import burn_blocks, state_blocks, total_dv
from formulations.problem.facets import Facets
from formulations.problem.flyby import FlybyProblem
from formulations.program.penalty import DYNAMICS_WEIGHT


@dataclass(frozen=True)
class SingleShooting:
    """A transcription; see `nlp_program.Transcription`. Of the start it takes the burns."""

    def __call__(
        self, problem: FlybyProblem, arcs: Arcs, facets: Facets | None, start: Start, elastic: bool
    ) -> Program:
        """Write the program down."""
        del elastic  # every row is a signed distance in any case
        spread, last = None, -1
        if facets is not None and len(facets.node):
            spread, last = Factor(problem, unit=initial_deviation(problem)), int(facets.node.max())
        x = ca.MX.sym("x", 3 * problem.n_burns)
        burns = ca.reshape(x, 3, problem.n_burns)
        node = _roll_out(problem, arcs, spread, last, burns)
        mean = ca.horzcat(*(y[:6] for y in node))
        blocks = (
            NlpRows(
                "final_state",
                mean[:, -1] - problem.final_state,
                DYNAMICS_WEIGHT,
                equality=True,
                price=problem.miss_weight,
            ),
            *burn_blocks(problem, burns, printed=False),
            *state_blocks(problem, facets, spread, node, printed=False),
        )
        point = start.iterate.burns.ravel()
        return Program(x, point, burns, mean, total_dv(burns), blocks)


def _roll_out(
    problem: FlybyProblem, arcs: Arcs, spread: Factor | None, last: int, burns: ca.MX
) -> list[ca.MX]:
    """States y = (mean, entries of the factor) of every node after its burn; entries up to `last`."""
    burn_at = dict(zip(problem.burn_nodes.tolist(), range(problem.n_burns), strict=True))
    entries = spread.pack(problem.first_factor, 0) if spread else np.zeros(0)
    y = ca.MX(np.concatenate([problem.initial_state, entries]))
    node = [y if problem.coasts else _burnt(y, spread, burns[:, 0], 0)]
    cuts = sorted({0, *burn_at, max(last, 0)})
    for first, end in itertools.pairwise(cuts):
        y = node[-1] if end <= last else node[-1][:6]
        node += ca.horzsplit(_fly(arcs, spread, y, first, end))
        if end in burn_at:
            node[-1] = _burnt(node[-1], spread, burns[:, burn_at[end]], burn_at[end])
    return node


def _burnt(y: ca.MX, spread: Factor | None, burn: ca.MX, burns: int) -> ca.MX:
    after = kick(spread if y.numel() > 6 else None, burn, burns)
    return after + ca.vertcat(y, ca.MX(after.numel() - y.numel(), 1))


def _fly(arcs: Arcs, spread: Factor | None, y: ca.MX, first: int, end: int) -> ca.MX:
    """The y at the ends of the arcs between two nodes, (s, n)."""
    symbol, h = ca.SX.sym("y", y.numel()), ca.SX.sym("h")
    function = ca.Function("arc", [symbol, h], [step(arcs, spread, symbol, h)])
    return function.mapaccum(end - first)(y, ca.DM(arcs.durations[first:end]).T)
