"""What an exact plan says of the risk that it spends: asked, aimed at, promised, reached."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Field, model_validator

from scp_recon.scenario.fields import Line
from scp_recon.solution.part import Part, Probability


class Reached(Part):
    """What nonlinear flights reached: at every second, and at the nodes alone."""

    samples: Annotated[int, Field(ge=1)]
    seed: Annotated[int, Field(ge=0)]
    reached: Probability
    low: Probability
    high: Probability
    at_nodes: Probability
    rounds: Annotated[int, Field(ge=1)]


class EventProbability(Part):
    """Probability of a joint constraint by the normal law, at its nodes; of a whole flight just one."""

    name: Line
    t_s: list[float]
    probability: list[Probability]

    @model_validator(mode="after")
    def _fit_together(self) -> EventProbability:
        if len(self.t_s) != len(self.probability) or not self.t_s:
            raise ValueError("there must be as many probabilities as times, and at least one")
        return self


class Risk(Part):
    """How an exact plan spends its risk; `certificate` is null where no flights stand behind it."""

    scope: Literal["node", "flight"]
    asked: Probability
    aim: Probability
    certificate: Reached | None
    normal_law: list[EventProbability]
