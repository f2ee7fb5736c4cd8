"""Plan a mission by sequential convex programming: P3, facets at its solution or exact risk, P2."""

from __future__ import annotations

from typing import Any, Literal

from formulations.arrays import Array
from formulations.problem.flyby import Iterate
from scp_recon.mission.mission import Mission
from scp_recon.planning.method import ALGORITHM, FORMULATION, SOLVER, FacetRounds
from scp_recon.planning.missions import continued, flown, make_plan, other_starts
from scp_recon.planning.plan import Plan, Provenance, Stage
from scp_recon.planning.records import Problem
from scp_recon.planning.solver import AnyProblem, Observer, StageSolver, unobserved
from scp_recon.planning.stages import Pipeline


class Planner(StageSolver[AnyProblem]):
    """Plans missions from a guess or a plan, with programs that it compiles once: see `StageSolver`."""

    method: Literal["scp", "ipopt"] = "scp"

    def plan(
        self: Planner[Mission],
        guess: Iterate | Plan,
        *,
        problem: Problem = "P2",
        facet_rounds: FacetRounds = 0,
        init: str = "given",
        observe: Observer | None = None,
        once: bool = False,
    ) -> Plan:
        """Solve P3 from the guess, choose the facets at its solution, and solve P2 from there.

        The guess may have defects. Exact risk continues from a plan, or a guess with gains, with its
        last stage, burns and gains together, and from the burns where that does not converge. Unless
        `once`, a stage that does not converge is tried from other starts (see `Pipeline.plan`), also
        where a last stage finds the case infeasible. In each of `facet_rounds` the facets are chosen
        again at the solution and P2 is solved again; a round is kept only if it is better (`rank`), so
        that facets cannot cycle. "settle" chooses them until none is cheaper: see `planning.settling`.
        Facets that leave nothing feasible are always chosen again, up to `CHOICES_MAX` times. Burns too
        small to execute are left out or raised (`missions.executable`). The observer is called after
        each iteration with the stage's name and the record.
        """
        mission = self.task
        pipeline = Pipeline(mission, self, observe or unobserved, facet_rounds)

        def work() -> Stage:
            start = flown(mission, guess) if isinstance(guess, Plan) else guess
            goes_on = problem == "P2" and (isinstance(guess, Plan) or start.gains.any())
            if goes_on and (stage := continued(mission, pipeline, start, once=once)):
                return stage
            return pipeline.plan(start, problem, () if once else other_starts(mission))

        known = guess.without_uncertainty if isinstance(guess, Plan) else None
        leads = problem == "P3" and self._resolution > 0.0
        made = self._provenance(init)
        return make_plan(mission, pipeline, work, *made, known, executes=not leads)

    def replan(self: Planner[Mission], last: Plan, initial_state: Array) -> Plan:
        """Solve P2 again for another initial state, from the last plan and with its facets.

        The state is that before the first burn, J2000, SI, shape (6,); its covariance is the mission's
        fraction of it. The last plan must be one of P2 by this planner; the new one's `mission` begins
        at the state.

        Raises:
            ValueError: if the plan is not one of P2, its mission differs in more than the initial
                state, or the state is not outside the body.
        """
        facets, lin = last.final.facets, last.final.result.lin
        if last.final.problem != "P2":
            raise ValueError("only a plan of P2 can be planned again")
        if last.mission.with_initial_state(initial_state).scenario != (
            self.task.with_initial_state(initial_state).scenario
        ):
            raise ValueError("the plan is of another mission")
        mission = self.task.with_initial_state(initial_state)
        pipeline = Pipeline(mission, self)

        def work() -> Stage:
            if facets is None:
                return pipeline.exact(pipeline.start(lin.iterate))
            # The last plan's iterate knows its factor; the facets are screened there.
            spec = self.p2_stage(facets, lin, again=True)
            return pipeline.choose_again(pipeline.solve(spec, pipeline.start(lin.iterate)))

        return make_plan(mission, pipeline, work, *self._provenance("plan"))

    def _provenance(self, init: str) -> tuple[Provenance, float | None]:
        """Words on how a plan is made, and the target probability of exact risk."""
        exact = self.task.risk.allocation == "exact"
        return Provenance(*self.names, init, self.method), self.target if exact else None


def plan(
    mission: Mission,
    guess: Iterate | Plan,
    *,
    formulation: str = FORMULATION,
    algorithm: str = ALGORITHM,
    solver: str = SOLVER,
    target: float | None = None,
    p3_resolution: float = 0.0,
    others: bool = True,
    **how: Any,
) -> Plan:
    """Plan a mission once: `Planner.plan` with its arguments and those of `Planner`."""
    planner = Planner(
        mission,
        formulation=formulation,
        algorithm=algorithm,
        solver=solver,
        target=target,
        p3_resolution=p3_resolution,
        others=others,
    )
    return planner.plan(guess, **how)
