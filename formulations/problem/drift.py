"""Free flights after a burn that does not happen, or that stops before its end."""

from __future__ import annotations

from dataclasses import dataclass, replace

from formulations.problem.flow import Flow
from formulations.problem.regions import Ball


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
