"""What to aim at, from what the rounds so far have lost between aim and flights.

On the normal quantile scale flights reach less than was aimed at by nearly the same, whatever the aim:
the flow's curvature, and what happens between nodes, take it. Each round's flights measure that loss
with the error of their sampling; the mean over rounds is surer than the last one's.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from scipy.special import ndtr, ndtri

from scp_recon.monte_carlo.certifying import successes_needed

SPARE = 0.1
"""Standard errors of the estimate by which a round aims above what it has to reach, and as much again
for each one after the first that did not."""

LEAST, MOST = 0.501, 1.0 - 1e-9
"""Aims: the constraint is convex above one half."""


@dataclass
class Aiming:
    """The aim of rounds of flights.

    Attributes:
        asked: probability whose lower limit is to be reached.
        samples: flights of a round.
        losses: of the rounds on the present nodes, in standard deviations.
        tries: rounds that have not reached what was asked.
    """

    asked: float
    samples: int
    losses: list[float] = field(default_factory=list)
    tries: int = 0

    @property
    def needed(self) -> float:
        """Share of the flights whose lower limit is what was asked."""
        return successes_needed(self.asked, self.samples) / self.samples

    @property
    def error(self) -> float:
        """Standard error of what a round reaches."""
        return float(np.sqrt(self.needed * (1.0 - self.needed) / self.samples))

    @property
    def loss(self) -> float:
        """Mean of the losses; none is expected before any flight."""
        return float(np.mean(self.losses)) if self.losses else 0.0

    def learn(self, law: float, reached: float) -> None:
        """Take in what flights reached of a probability by the normal law."""
        self.losses.append(float(ndtri(law)) - self._quantile(reached))

    def begin_again(self, law: float, at_nodes: float) -> None:
        """Forget the rounds on other nodes, but for what the last lost at its nodes.

        What it lost between them the nodes that are added give back.
        """
        self.losses = []
        self.learn(law, at_nodes)

    def next(self) -> float:
        """What to aim at to reach what is needed."""
        above = self.needed + SPARE * max(1, self.tries) * self.error
        return float(np.clip(ndtr(self._quantile(above) + self.loss), LEAST, MOST))

    def excess(self, aim: float) -> float:
        """By how much an aim spends too little, in standard errors of what the rounds have measured.

        Positive where it reaches more than what is needed.
        """
        most, least = (ndtr(ndtri(aim) - self.loss) for aim in (aim, self.next()))
        return float((most - least) / self.error * np.sqrt(len(self.losses)))

    def _quantile(self, probability: float) -> float:
        half = 0.5 / self.samples
        return float(ndtri(np.clip(probability, half, 1.0 - half)))
