"""How P3 begins where its guess is no flight: first without the sets that part the ways past them.

A keep-out set is linearised by the plane that touches it nearest to the iterate, so that an iterate is
held to the side it is on. Where a path that nobody could fly lies says nothing of sides: P3 then begins
without the keep-out sets of a part of the flight, whose answer hardly depends on the guess, and goes on
from there with all of them, on the side nearest to it. The answer without them costs at most what any
plan with them does, so that where it keeps them there is nothing better near it.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from formulations.linearisation.linearisation import Linearisation
from formulations.problem.flyby import FlybyProblem

RESOLUTION = 1e-3
"""Relative reduction of the merit at which the opening stops: P3 goes on from there."""

NO_BURN = 1e-6
"""Total delta-v, nondimensional, below which a guess has no burns that could be wrong."""


def contradicts_itself(lin: Linearisation) -> bool:
    """Whether a guess claims burns, and its path takes more delta-v between nodes than these are.

    A trajectory from elsewhere, given coarsely, does not. A path without burns, as the paper's straight
    line, claims nothing.
    """
    kicks = float(np.linalg.norm(lin.defects[:-1, 3:], axis=1).sum())
    return NO_BURN < lin.iterate.total_dv < kicks


def opened(problem: FlybyProblem) -> FlybyProblem:
    """The problem without the keep-out sets of a part of the flight.

    What holds throughout stays: it keeps the path away from where the dynamics are singular.
    """
    kept = [c for c in problem.constraints if c.keep == "in" or len(c.nodes) == problem.n_nodes]
    return replace(problem, constraints=tuple(kept))
