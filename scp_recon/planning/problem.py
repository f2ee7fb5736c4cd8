"""Protocol of a problem that can be planned: a mission, or an `ImpulsiveProblem`."""

from __future__ import annotations

from typing import Literal, Protocol

from formulations.linearisation.dynamics import Dynamics
from formulations.problem.facets import Polytopes
from formulations.problem.flyby import FlybyProblem


class RiskSpec(Protocol):
    """Required probability, and how the risk is allocated: see `scp_recon.scenario.schema.Risk`."""

    @property
    def p_chance(self) -> float:
        """Required probability."""

    @property
    def allocation(self) -> Literal["uniform", "exact"]:
        """Split of the risk: "uniform" over facets, or "exact" by the probabilities of the sets."""

    @property
    def scope(self) -> Literal["node", "flight"]:
        """What must hold with that probability: each node, or the whole flight."""


class PlanningProblem(Protocol):
    """A problem to plan: a mission, or an `ImpulsiveProblem`."""

    @property
    def problem(self) -> FlybyProblem:
        """The nondimensional problem."""

    @property
    def dynamics(self) -> Dynamics:
        """Its flow with its burns."""

    @property
    def polytopes(self) -> Polytopes:
        """Polytopes that approximate regions where risk is split evenly."""

    @property
    def risk(self) -> RiskSpec:
        """Required probability and allocation of the risk."""

    @property
    def clearances(self) -> tuple[float, float]:
        """Margins beyond which facets stay out of a program at first: from P3, and from P2."""

    def require_plain(self, needs: str) -> None:
        """Refuse feedback and limits on the final covariance, which go with `needs` alone.

        Raises:
            InputError: if there is either.
        """
