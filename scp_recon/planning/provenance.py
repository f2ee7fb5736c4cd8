"""What a plan says of its making: method, starts, certificate, and the plan before it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
import numpy.typing as npt

Array = npt.NDArray[np.float64]


@dataclass(frozen=True)
class Provenance:
    """How a plan was made, in the words of the solution file.

    Attributes:
        formulation: of the convex subproblem, or the variant of the nonlinear program.
        algorithm: around it.
        solver: conic solver, or IPOPT.
        init: where it began: "cold", "warm", a file.
        method: sequential convex programming, the nonlinear programs by IPOPT, or none where nothing
            was optimised.
    """

    formulation: str
    algorithm: str
    solver: str
    init: str
    method: Literal["scp", "ipopt", "none"] = "scp"


@dataclass(frozen=True)
class Certificate:
    """What nonlinear flights of an exact plan reach, at every second.

    Attributes:
        samples: flights.
        seed: of their errors, which planning has not seen.
        reached: probability, of the node where it is least or of whole flights.
        low: lower end of its confidence interval.
        high: upper end.
        at_nodes: the same probability of the nodes alone.
        rounds: plans made until this one.
    """

    samples: int
    seed: int
    reached: float
    low: float
    high: float
    at_nodes: float
    rounds: int


@dataclass(frozen=True)
class Optimum:
    """A local optimum that several starts found.

    Attributes:
        problem: of which.
        status: converged, or infeasible: stationary at the least violation.
        total_dv_m_s: sum of the burns' sizes.
        burns_m_s: J2000, m/s.
        starts: numbers of those that ended there, 0 the guess.
    """

    problem: Literal["P3", "P2"]
    status: str
    total_dv_m_s: float
    burns_m_s: tuple[tuple[float, float, float], ...]
    starts: tuple[int, ...]

    def __str__(self) -> str:
        """One line."""
        many = f"{len(self.starts)} start{'s' if len(self.starts) > 1 else ''}"
        return f"{self.problem} {self.status} {self.total_dv_m_s:.6f} m/s, {many}"


@dataclass(frozen=True)
class Starts:
    """Several starts; the plan is the best of them.

    Attributes:
        number: asked for, the guess included.
        seed: of the others.
        optima: where they ended, each once.
    """

    number: int
    seed: int
    optima: tuple[Optimum, ...]


@dataclass(frozen=True)
class Parent:
    """The plan that was flown before another was made in flight.

    Attributes:
        name: its file, or what it was.
        plan_hash: of its scenario and burns.
        at_s: time of the state from which the new one was made, s past the epoch.
    """

    name: str
    plan_hash: str
    at_s: float
