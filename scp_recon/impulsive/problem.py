"""State an impulsive transfer by arrays, of any flow and in any units, and plan it.

    problem = ImpulsiveProblem(flow, burn_nodes, start, goal, dv_max=0.2)
    plan = problem.solve()

Without errors only the burns are planned (P3). With errors of the initial state or of burns, every
region is kept with a probability (P2). The stages are those of missions. This module scales the
user's units.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, partial
from typing import Literal

import numpy as np
import numpy.typing as npt
from scipy.linalg import block_diag

from formulations.arrays import Array
from formulations.linearisation.dynamics import Dynamics
from formulations.problem.controls import Feedback
from formulations.problem.execution_errors import ComponentwiseErrors, ExecutionErrors, GatesErrors
from formulations.problem.expression_flow import ExpressionFlow
from formulations.problem.facets import Polytopes, ball, split_risk
from formulations.problem.flow import Flow, ScaledFlow, check_flow
from formulations.problem.flyby import FlybyProblem, Iterate, StateConstraint
from formulations.problem.regions import Ball, Cone, Ellipsoid, Halfspaces, Polytope
from scp_recon.certification.certify import certified
from scp_recon.certification.flights import Step
from scp_recon.errors import InputError, one_of
from scp_recon.impulsive.plan import ImpulsivePlan
from scp_recon.impulsive.regions import Keep, covariance_factor, finite, positive, scaled
from scp_recon.jobs.cores import one_thread
from scp_recon.monte_carlo.whole_flight import KeptCounts
from scp_recon.planning.method import ALGORITHM, FORMULATION, SOLVER, scp_method
from scp_recon.planning.planner import Planner
from scp_recon.planning.solver import Observer, unobserved
from scp_recon.planning.stages import Pipeline
from scp_recon.scenario.schema import Risk

__all__ = [
    "Ball",
    "ComponentwiseErrors",
    "Cone",
    "Ellipsoid",
    "ExpressionFlow",
    "Feedback",
    "GatesErrors",
    "Halfspaces",
    "ImpulsiveProblem",
    "Keep",
    "Polytope",
]

FACETS, CONE_FACETS = 24, 8
"""Facets of the polytopes about balls and about cones where risk is split evenly."""

NO_ERRORS = ComponentwiseErrors(0.0)
PAIRS = {"units": "a length and a time", "final_sigma": "of position and of velocity, or None"}


@dataclass(frozen=True, eq=False)
class ImpulsiveProblem:
    """Reach a state by impulsive burns at least cost, in the units of the user's flow.

    States are those after a burn at their node. Arrays may be lists.

    Examples:
        >>> import scp_recon as sr
        >>> flow = sr.ExpressionFlow(lambda r, v, t, p: -r, [0.0, 1.0, 2.0], substeps=20)
        >>> start, goal = [1.0, 0.0, 0.0, 0.0, 0.0, 0.0], [0.0, 1.0, 0.0, 0.0, 0.0, 0.0]
        >>> plan = sr.ImpulsiveProblem(flow, [0, 1, 2], start, goal, dv_max=2.0).solve()
        >>> plan.ok, round(plan.cost, 4)
        (True, 1.9541)

    Attributes:
        flow: the motion between nodes, n arcs; `ExpressionFlow`, or any other.
        burn_nodes: node of each burn, ascending from 0 to n; the last is n.
        initial_state: mean before a burn at the first node, shape (6,).
        final_state: mean after the last burn, shape (6,).
        dv_max: largest burn; it is also the unit of speed, so be it of the order of burns.
        initial_covariance: of the initial state, shape (6, 6); none by default.
        parameter_covariance: of the flow's q parameters, shape (q, q): constants of a flight, of normal
            law; known by default. Only with an `ExpressionFlow`.
        errors: of executing burns; none by default.
        regions: to be kept in or out of.
        probability: required probability that each region is kept at each node, or that whole
            flights keep all regions.
        scope: "node" or "flight", whose risk is spent exactly; "uniform", at each node, evenly split
            over facets.
        final_sigma: limits on the root of the summed variances of position and of velocity at the end.
        feedback: corrected burns, their measurements, and the cost to minimise; none by default.
        units: of length and of time within; by default the larger distance of the boundary positions
            from the origin, and the time in which `dv_max` goes so far.

    Raises:
        InputError: if entries contradict each other.
    """

    flow: Flow
    burn_nodes: npt.ArrayLike
    initial_state: npt.ArrayLike
    final_state: npt.ArrayLike
    dv_max: float
    initial_covariance: npt.ArrayLike | None = None
    errors: ExecutionErrors | None = None
    regions: Sequence[Keep] = ()
    probability: float = 0.99
    scope: Literal["uniform", "node", "flight"] = "node"
    final_sigma: tuple[float | None, float | None] = (None, None)
    feedback: Feedback | None = None
    units: tuple[float, float] | None = None
    parameter_covariance: npt.ArrayLike | None = None

    def __post_init__(self) -> None:
        """Refuse entries that contradict each other."""
        one_of("scope", self.scope, ("uniform", "node", "flight"))
        if not isinstance(getattr(self.flow, "arcs", None), int):
            raise InputError("flow", f"{self.flow!r}", "must be a flow, such as ExpressionFlow")
        n, nodes = self.flow.arcs, np.asarray(self.burn_nodes)
        if nodes.ndim != 1 or not len(nodes) or nodes.dtype.kind != "i" or nodes[-1] != n:
            raise InputError("burn_nodes", f"{nodes.tolist()}", f"must be indices, the last {n}")
        if nodes[0] < 0 or np.any(np.diff(nodes) <= 0):
            raise InputError("burn_nodes", f"{nodes.tolist()}", "must ascend from 0")
        for name in ("initial_state", "final_state"):
            finite(name, getattr(self, name), (6,))
        positive("dv_max", self.dv_max)
        if not 0.5 < positive("probability", self.probability) <= 1.0 - 1e-9:
            raise InputError("probability", f"{self.probability}", "must be in (0.5, 1)")
        for name, pair in (("units", self.units), ("final_sigma", self.final_sigma)):
            if pair is not None and np.shape(np.array(pair, dtype=object)) != (2,):
                raise InputError(name, f"{pair}", "must be two: " + PAIRS[name])
        for size in self.units or ():
            positive("units", size)
        if not isinstance(self.errors, ExecutionErrors | None):
            raise InputError("errors", f"{self.errors!r}", "must be a model, such as GatesErrors")
        for limit in self.final_sigma:
            if limit is not None:
                positive("final_sigma", limit)
        if not (
            isinstance(self.regions, Sequence) and all(isinstance(k, Keep) for k in self.regions)
        ):
            given = f"{self.regions!r}"
            raise InputError("regions", given, 'must be a list of Keep("in" or "out", ..)')
        names = [name for name, _ in self._named]
        if len(set(names)) < len(names):
            raise InputError("regions", f"the names {', '.join(names)}", "must differ")
        if self.feedback is not None:
            self._check_feedback(self.feedback)
        if self.is_deterministic:
            self.require_plain("errors: initial_covariance, or errors of burns")
        _ = self.problem

    def _check_feedback(self, feedback: Feedback) -> None:
        nodes, k = np.asarray(self.burn_nodes), len(feedback.burns)
        shape = np.shape(feedback.measurement)
        if shape != (k, 6, 6) or len(feedback.cut_offs) != k:
            needs = f"must be ({k}, 6, 6), and {k} cut-offs, for {k} corrected burns"
            raise InputError("feedback.measurement", f"shape {shape}", needs)
        burns, cut_offs = np.asarray(feedback.burns), np.asarray(feedback.cut_offs)
        if not k or burns[0] < 0 or burns[-1] >= len(nodes) or np.any(np.diff(burns) <= 0):
            needs = f"must be numbers of burns, ascending from 0 to {len(nodes) - 1}"
            raise InputError("feedback.burns", f"{burns.tolist()}", needs)
        if cut_offs[0] < 0 or np.any(np.diff(cut_offs) <= 0):
            raise InputError("feedback.cut_offs", f"{cut_offs.tolist()}", "must ascend from 0")
        one_of("feedback.cost", feedback.cost, ("nominal", "expected", "dv99"))
        if not 0.5 < feedback.probability < 1.0:
            found = f"{feedback.probability}"
            raise InputError("feedback.probability", found, "must be in (0.5, 1)")
        if np.any(cut_offs > nodes[burns]):
            found = f"cut-offs {list(feedback.cut_offs)}"
            raise InputError("feedback.cut_offs", found, "must not be after their burns' nodes")
        if k > 1 and isinstance(self.errors, GatesErrors) and self.errors.shared:
            found = f"magnitude_bias {self.errors.magnitude_bias} with {k} corrected burns"
            raise InputError("errors", found, "must be 0: no filter estimates what burns share")

    @property
    def _named(self) -> Iterator[tuple[str, Keep]]:
        """The regions by name."""
        for number, keep in enumerate(self.regions, start=1):
            yield keep.name or f"{type(keep.region).__name__.lower()} {number}", keep

    @cached_property
    def length(self) -> float:
        """Unit of length of the nondimensional problem."""
        states = np.array([self.initial_state, self.final_state], dtype=float)
        far = float(np.linalg.norm(states[:, :3], axis=1).max())
        return self.units[0] if self.units else far or 1.0

    @cached_property
    def unit(self) -> Array:
        """Units of the state's components, shape (6,)."""
        speed = self.length / self.units[1] if self.units else float(self.dv_max)
        return np.repeat([self.length, speed], 3)

    @property
    def is_deterministic(self) -> bool:
        """Whether there are no errors."""
        given = self.initial_covariance, self.parameter_covariance, self.errors
        return all(one is None for one in given)

    @property
    def risk(self) -> Risk:
        """How risk is spent: see `scp_recon.planning.plan.PlanningProblem`."""
        if self.scope == "uniform" or not self.regions:
            return Risk(p_chance=self.probability)
        return Risk(p_chance=self.probability, allocation="exact", scope=self.scope)

    @property
    def clearances(self) -> tuple[float, float]:
        """Infinite, so that every facet is in the program."""
        return np.inf, np.inf

    @cached_property
    def polytopes(self) -> Polytopes:
        """Polytopes with 24 facets about balls, and 8 about cones."""
        return Polytopes(ball(FACETS), CONE_FACETS)

    def require_plain(self, needs: str) -> None:
        """See `scp_recon.planning.plan.PlanningProblem`."""
        if self.feedback is not None:
            raise InputError("feedback", "corrected burns", f"goes with {needs}")
        if self.final_sigma != (None, None):
            raise InputError("final_sigma", f"{self.final_sigma}", f"goes with {needs}")

    @cached_property
    def dynamics(self) -> Dynamics:
        """Nondimensional flow map with the burns."""
        return Dynamics(ScaledFlow(self.flow, self.unit), self.problem.burn_nodes)

    @cached_property
    def problem(self) -> FlybyProblem:
        """The nondimensional problem."""
        unit, nodes, limits = self.unit, np.array(self.burn_nodes, dtype=np.intp), self.final_sigma
        known = np.zeros((6, 6)) if self.initial_covariance is None else self.initial_covariance
        factor = covariance_factor("initial_covariance", known, 6) / unit[:, None]
        if self.parameter_covariance is not None:
            if not isinstance(self.flow, ExpressionFlow):
                given = f"with the flow {type(self.flow).__name__}"
                raise InputError("parameter_covariance", given, "goes with an ExpressionFlow")
            covariance, size = self.parameter_covariance, len(self.flow.parameters)
            factor = block_diag(factor, covariance_factor("parameter_covariance", covariance, size))
        feedback = self.feedback
        if feedback is not None:
            measurement = np.asarray(feedback.measurement, dtype=float) / unit[:, None]
            of = np.array(feedback.burns, np.intp), np.array(feedback.cut_offs, np.intp)
            feedback = replace(feedback, burns=of[0], cut_offs=of[1], measurement=measurement)
        return FlybyProblem(
            n_nodes=self.flow.arcs + 1,
            burn_nodes=nodes,
            initial_state=np.asarray(self.initial_state, dtype=float) / unit,
            final_state=np.asarray(self.final_state, dtype=float) / unit,
            initial_factor=factor,
            execution_errors=(self.errors or NO_ERRORS).in_units(unit[3]),
            dv_max=self.dv_max / unit[3],
            sun=np.tile([0.0, 0.0, 1.0], (len(nodes), 1)),
            dv_cone=0.0,
            constraints=tuple(c for named in self._named for c in self._constraints(*named)),
            final_spread=(limits[0] and limits[0] / unit[0], limits[1] and limits[1] / unit[3]),
            feedback=feedback,
        )

    def _constraints(self, name: str, keep: Keep) -> Iterator[StateConstraint]:
        """A region's constraint, or those of the faces of a polytope that is kept in."""
        n = self.flow.arcs
        nodes = np.arange(1, n + 1) if keep.nodes is None else np.asarray(keep.nodes)
        if nodes[-1] > n:
            raise InputError(f"{name}: nodes", f"{keep.nodes}", f"must be at most {n}")
        region = scaled(name, keep.region, len(nodes), self.length)
        p = self.probability
        if keep.side == "out" or not isinstance(region, Polytope):
            yield StateConstraint(name, nodes, region, keep.side, p)
            return
        for face, (a, b) in enumerate(zip(region.normal, region.offset, strict=True), start=1):
            half = Halfspaces(np.tile(a, (len(nodes), 1)), np.full(len(nodes), b))
            share = split_risk(p, len(region.offset))
            yield StateConstraint(f"{name}, face {face}", nodes, half, "in", share, name)

    def guess(
        self, states: npt.ArrayLike | None = None, burns: npt.ArrayLike | None = None
    ) -> Iterate:
        """Make a guess from states (n + 1, 6), which may jump at nodes; by default the straight line.

        Burns have shape (m, 3), by default none.
        """
        problem, n = self.problem, self.flow.arcs
        if states is None:
            share = np.linspace(0.0, 1.0, n + 1)[:, None]
            mean = (1.0 - share) * problem.initial_state + share * problem.final_state
        else:
            mean = finite("guess", states, (n + 1, 6)) / self.unit
        if burns is None:
            return Iterate(np.zeros((problem.n_burns, 3)), mean)
        return Iterate(finite("burns", burns, (problem.n_burns, 3)) / self.unit[3], mean)

    @one_thread
    def solve(
        self,
        states: npt.ArrayLike | None = None,
        *,
        burns: npt.ArrayLike | None = None,
        formulation: str = FORMULATION,
        algorithm: str = ALGORITHM,
        solver: str = SOLVER,
        target: float | None = None,
        observe: Observer | None = None,
    ) -> ImpulsivePlan:
        """Plan from a guess (see `guess`). `target` is for exact risk, by default `probability`.

        `observe` is called after each iteration with the name of its stage and its record.

        Raises:
            InputError: if guess or names do not fit, or the flow's derivatives are not its map's.
        """
        method, start = scp_method(formulation, algorithm, solver), self.guess(states, burns)
        try:
            check_flow(self.flow, self.unit, start.mean[:-1])
        except ValueError as error:
            smooth = "or the guess leads where it is not smooth: give states"
            needs = f"must be those of one map; {smooth}"
            raise InputError("flow", str(error), needs) from None
        planner = Planner(self, **method._asdict(), target=target)
        run = Pipeline(self, planner, observe or unobserved)
        final = run.plan(start, "P3" if self.is_deterministic else "P2")
        return ImpulsivePlan(
            self.dynamics,
            self.unit,
            stages=tuple(run.stages),
            final=final,
            timing=run.timing,
            target=planner.target,
        )

    @one_thread
    def certify(
        self,
        states: npt.ArrayLike | None = None,
        *,
        burns: npt.ArrayLike | None = None,
        formulation: str = FORMULATION,
        algorithm: str = ALGORITHM,
        solver: str = SOLVER,
        observe: Observer | None = None,
        watch: Callable[[str, int, int], None] = lambda *_: None,
    ) -> ImpulsivePlan:
        """Plan so that independent flights reach the required probability; arguments as of `solve`.

        Rounds of flights adjust the target, and independent flights judge, as in
        `scp_recon.certification`. `watch` is called with the name of a step, such as "calibration 1",
        and the number of its flights so far and in all.

        Returns:
            As `scp_recon.certification.certify.certified`.

        Raises:
            InputError: as `solve`; or if risk is not exact.
        """
        if self.is_deterministic or self.risk.allocation != "exact":
            raise InputError("scope", self.scope, "must be node or flight, of regions, with errors")
        solve = partial(self.solve, formulation=formulation, algorithm=algorithm, solver=solver)

        def anew(last: ImpulsivePlan | None, _: Array, target: float) -> ImpulsivePlan:
            start = (states, burns) if last is None else (last.states, last.burns)
            return solve(start[0], burns=start[1], target=target, observe=observe)

        def fly(plan: ImpulsivePlan, step: Step) -> KeptCounts:
            report = partial(watch, step.name)
            flights = plan.fly(step.samples, step.seed, lambda flown: report(flown, step.samples))
            found = [flights.whole] if self.scope == "flight" else flights.kept.values()
            kept = round(step.samples * min(estimate.value for estimate in found))
            return KeptCounts(kept, kept, step.samples)

        return certified(self.probability, anew, fly)
