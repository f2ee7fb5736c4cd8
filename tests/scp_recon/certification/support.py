"""A world in which planning takes no time, and flights reach what a test says."""

from collections.abc import Callable
from dataclasses import dataclass, field, replace

import numpy as np

from formulations.problem.flyby import Iterate
from scp_recon.certification import certify as certification
from scp_recon.certification import flights
from scp_recon.mission.mission import Mission
from scp_recon.monte_carlo.whole_flight import KeptCounts, SampledFlights
from scp_recon.planning import initial_guess
from scp_recon.planning.plan import Plan
from scp_recon.planning.planner import plan
from scp_recon.scenario.load import load_scenario
from scp_recon.scp.status import Status

Reached = tuple[float, float]
"""Share of the flights that keep everything at the nodes, and at all times."""


def mission_of(scope: str, asked: float = 0.9, sampling: str = "plain") -> Mission:
    """The default scenario with exact risk."""
    risk = {"p_chance": asked, "allocation": "exact", "scope": scope, "sampling": sampling}
    return Mission.from_scenario(load_scenario().replace({"risk": risk}))


def a_plan(asked: float = 0.9) -> Plan:
    """One to make others of."""
    mission = mission_of("flight", asked)
    quick = Mission.from_scenario(mission.scenario.replace({"risk.scope": "node"}))
    return replace(plan(quick, initial_guess.cold(quick)), mission=mission)


@dataclass
class World:
    """What plans cost and what their flights reach.

    Attributes:
        real: plan that all others are made of; they cost in proportion to what they aim at.
        reach: shares of flights of an aim, flown with a seed; it may raise.
        slack: standard deviations by which the law keeps more than a plan aims at.
        status: how planning for an aim ends, from a start of a name.
        aims: of all plans made.
        seeds: of all flights, in their order.
        missions: that they were of.
    """

    real: Plan
    reach: Callable[[float, int], Reached]
    status: Callable[[float, str], Status] = lambda *_: Status.CONVERGED
    touched_s: tuple[float, ...] = ()
    slack: float = 0.0
    aims: list[float] = field(default_factory=list)
    seeds: list[int] = field(default_factory=list)
    missions: list[Mission] = field(default_factory=list)

    def make_plan(
        self, mission: Mission, start: Iterate | Plan, target: float, **_: object
    ) -> Plan:
        """A plan of the mission with the real one's stages, its burns scaled by its aim."""
        assert isinstance(start, Plan) or len(start.mean) == len(mission.times_s)
        self.aims.append(target)
        self.missions.append(mission)
        result = self.real.final.result
        iterate = replace(result.lin.iterate, burns=result.lin.iterate.burns * target)
        lin = replace(result.lin, iterate=iterate)
        name = "given" if start is self.real.final.result.lin.iterate else "last"
        ended = replace(result, lin=lin, status=self.status(target, name))
        final = replace(self.real.final, result=ended)
        return replace(self.real, mission=mission, final=final, target=target, certificate=None)

    def fly(self, flights: SampledFlights, samples, progress=None) -> KeptCounts:
        """Flights of the plan with such burns."""
        aim = np.linalg.norm(flights.burns_m_s) / np.linalg.norm(self.real.burns_m_s)
        self.seeds.append(flights.seed)
        shares = self.reach(min(self.aims, key=lambda made: abs(made - aim)), flights.seed)
        if progress:
            progress(samples)
        counts = [round(share * samples) for share in shares]
        return KeptCounts(*counts, samples, np.array(self.touched_s))

    def last_burns(self, mission: Mission, *_: object) -> Iterate:
        """A start on the mission's grid, whatever its states."""
        states = self.start.mean[:1]
        return replace(self.start, mean=np.repeat(states, len(mission.times_s), axis=0))

    @property
    def start(self) -> Iterate:
        """That planning begins at."""
        return self.real.final.result.lin.iterate

    def enter(self, patch) -> None:
        """Let certification take place here."""
        patch.setattr(certification, "slack", lambda _: self.slack)
        patch.setattr(flights, "kept_flights", self.fly)
        patch.setattr(initial_guess, "from_burns", self.last_burns)
