"""A problem that can be planned, as a protocol; a plan as data: its stages, provenance, figures in SI.

A stage is one run of the SCP or of IPOPT.
"""

from __future__ import annotations

from dataclasses import dataclass, fields, replace
from functools import cached_property
from typing import Literal, Protocol, TypeVar

import numpy as np

from formulations.arrays import Array
from formulations.linearisation.dynamics import Dynamics
from formulations.problem.controls import Cost
from formulations.problem.cost import PROBABILITY, total_sizes
from formulations.problem.facets import Facets, Polytopes
from formulations.problem.flyby import FlybyProblem, Iterate
from formulations.program.subproblem import MeritFunction
from formulations.rows.cones import FINAL_POSITION, FINAL_VELOCITY, Margins, Rows
from formulations.rows.corrected_burns import BATTERY, SIZE
from formulations.rows.uniform import ChanceRows
from scp_recon.display import Displayed
from scp_recon.errors import Named
from scp_recon.mission.mission import Mission
from scp_recon.mission.scene import Units
from scp_recon.planning.records import Certificate, Parent, Problem, Starts, WithoutUncertainty
from scp_recon.scenario.schema import Risk
from scp_recon.scp.algorithms import SCvx
from scp_recon.scp.loop import Result, Timing
from scp_recon.scp.status import Status


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
    def risk(self) -> Risk:
        """Required probability and allocation of the risk."""

    @property
    def clearances(self) -> tuple[float, float]:
        """Margins beyond which facets stay out of a program at first: from P3, and from P2."""

    def require_plain(self, needs: str) -> None:
        """Refuse feedback and limits on the final covariance, which go with `needs` alone.

        Raises:
            InputError: if there is either.
        """


Unit = Literal["m", "m/s", "sigma"]
"""Units of a margin in SI; sigma is a standard deviation on the normal quantile scale."""

NOT_CHECKED = "not checked"
"""What is said of a plan that was not verified yet."""
NO_BURN = f" {'0':>10}"
BURN_LIMITS = ("dv_max", "dv_battery", SIZE, BATTERY)


def scales(units: Units) -> dict[Unit, float]:
    """SI value of one nondimensional unit of a margin."""
    return {"m": units.length_m, "m/s": units.speed_m_s, "sigma": 1.0}


Role = Literal["final", "open", "node", "coarse", "led", "grown", "held", "settled"]
"""Purpose of a stage: the "final" one of its problem, or one that

- "open": leads to P3 from a guess that is no flight, or to P2 with gains from a plan without;
- "node", "coarse": leads to P2 of whole flights, by the risk at nodes, then by few directions;
- "led": leads to gains where there is no plan without gains;
- "grown": leads a drift out of a ball, by smaller balls;
- "held": plans again with burns held that would be too small to execute;
- "settled": plans with facets chosen along plans before it, until no choice is cheaper.
"""


@dataclass(frozen=True, eq=False)
class StageSpec:
    """A stage to run.

    Attributes:
        problem: to solve.
        rows: its constraints.
        role: purpose of the stage.
        start: letter of the start: "" for the guess, "b" the ballistic arc, "c" and "d" a turn about
            the body either way.
        choice: number of the choice of facets, from 1.
        judges: rows by which the stage is judged, if not its own.
        max_iterations: limit of its iterations; None for the algorithm's.
        weight: penalty weight of violations, which stays; None for the algorithm's weights.
        resolution: relative reduction of the merit at which it stops, if that of its rows is smaller.
        is_required: whether later stages are in vain if it does not converge.
        doubt: violation up to which they are not, because the stage's rows err by as much.
        fallback: stage that replaces the later ones but the last if it does not converge.
        title: name in place of the composed one.
    """

    problem: Problem
    rows: Rows
    role: Role = "final"
    start: str = ""
    choice: int = 1
    judges: Rows | None = None
    max_iterations: int | None = None
    weight: float | None = None
    resolution: float = 0.0
    is_required: bool = False
    doubt: float = 0.0
    fallback: StageSpec | None = None
    title: str = ""

    @property
    def name(self) -> str:
        """Name in the solution file, e.g. "P3", "P2b", "P2.2" with the second choice, "P3.open"."""
        choice = f".{self.choice}" if self.choice > 1 else ""
        role = "" if self.role == "final" else f".{self.role}"
        return self.title or f"{self.problem}{self.start}{choice}{role}"


@dataclass(frozen=True, eq=False, repr=False)
class Stage:
    """A run of the SCP, or of IPOPT, on one problem.

    Attributes:
        spec: what was run.
        result: how it ended and where.
        merit: its merit function, which also gives the margins of constraints.
        tolerance: largest violation that counts as none.
    """

    spec: StageSpec
    result: Result
    merit: MeritFunction
    tolerance: float

    def __repr__(self) -> str:
        """One line."""
        result = self.result
        return f"<Stage {self.name}: {result.status.value.name}, {len(result.records)} iterations>"

    @property
    def name(self) -> str:
        """Name in the solution file: see `StageSpec`."""
        return self.spec.name

    @property
    def problem(self) -> Problem:
        """Problem solved."""
        return self.spec.problem

    @property
    def facets(self) -> Facets | None:
        """Facets of P2 with polytopes; None otherwise."""
        rows = self.merit.rows
        return rows.facets if isinstance(rows, ChanceRows) else None

    @property
    def cost(self) -> float:
        """What planning minimises, nondimensional."""
        return self.merit.cost(self.result.lin)

    @property
    def violation(self) -> float:
        """Largest violation, nondimensional."""
        return self.merit.worst_violation(self.result.lin)

    def unit(self, constraint: str) -> Unit:
        """Unit of a constraint's margins in SI."""
        if constraint in (*BURN_LIMITS, FINAL_VELOCITY):
            return "m/s"
        if constraint == FINAL_POSITION:
            return "m"
        if constraint in {drift.name for drift in self.merit.problem.drifts}:
            return "sigma"
        return "m" if self.merit.rows.unit == "length" else "sigma"

    @property
    def drifts(self) -> dict[str, Array]:
        """Means of drifts at the end, by their names, of those that are known in full."""
        if not self.merit.problem.drifts:
            return {}
        margins = self.merit.margins(self.result.lin)
        return {name: own.path for name, own in margins.items() if own.path is not None}

    @property
    def margins(self) -> dict[str, Margins]:
        """Margins by constraint, those of facets left out of the convex program included."""
        lin = self.result.lin
        margins = self.merit.margins(lin)
        if self.facets is not None:
            margin = self.facets.margin(lin.iterate.mean, lin.spread.factor)
            for index, constraint in enumerate(self.merit.problem.constraints):
                rows = self.facets.constraint == index
                margins[constraint.name] = Margins(self.facets.node[rows], margin[rows])
        return margins


def is_converged(stage: Stage) -> bool:
    """Whether a run has a plan."""
    return stage.result.status is Status.CONVERGED


def rank(stage: Stage, *, saving: float = 0.0) -> tuple[int, float]:
    """Rank of a run, the better the greater: by how it ended, then by cost.

    It ended solved (3), at a point that violates nothing (2), otherwise (1), or without an answer of
    the solver (0). A relative `saving` ranks it as if it were cheaper.
    """
    ended = 0 if stage.result.status is Status.SOLVER_FAILED else 1
    if stage.result.status is Status.CONVERGED:
        ended = 3
    elif stage.violation <= stage.tolerance:
        ended = 2
    return ended, -(1.0 - saving) * merit_of(stage)


def merit_of(stage: Stage, weight: float = SCvx.weight) -> float:
    """Merit of a run's end with a weight of violations, by default the first."""
    return stage.merit(stage.result.lin, weight)


@dataclass(frozen=True)
class Provenance:
    """Method, start and solver of a plan, in the words of the solution file.

    With IPOPT, `formulation` is the variant of the nonlinear program. `init` names the initial
    guess: "cold", "warm", or a file. The method is "none" if burns were only evaluated.

    Attributes:
        formulation: of the convex program, or variant of the nonlinear one.
        algorithm: "scvx", "ptr", "scvx-star"; "none" where nothing was optimised.
        solver: that solved the programs.
        init: where planning began.
        method: "scp" or "ipopt"; "none" where nothing was optimised.
    """

    formulation: str
    algorithm: str
    solver: str
    init: str
    method: Literal["scp", "ipopt", "none"] = "scp"


@dataclass(frozen=True, eq=False, repr=False, kw_only=True)
class StagedPlan:
    """What plans of missions and of impulsive problems have in common.

    Attributes:
        stages: all runs; the final one need not be the last.
        final: the run that holds the answer.
        timing: of all stages, s.
        target: probability that the rows of an exact plan are held to; None of others.
        certificate: probability that flights of an exact plan reached; None without such flights.
    """

    stages: tuple[Stage, ...]
    final: Stage
    timing: Timing
    target: float | None = None
    certificate: Certificate | None = None

    @property
    def status(self) -> Status:
        """Status of the final stage."""
        return self.final.result.status


@dataclass(frozen=True, eq=False, repr=False)
class Plan(StagedPlan, Displayed):
    """The stages of planning a mission; `final` holds the answer.

    A plan is data: it pickles and copies, and its arrays are read-only. Two plans are equal if
    scenario, provenance, certificate, parent, stages and flight are equal to the last bit. Timings
    do not count. The plans of a new solver and of one kept from an earlier plan may differ in the
    last digits.

    Attributes:
        mission: that was planned.
        provenance: method, start and solver.
        total_s: of planning, s.
        starts: local optima, where there were several starts.
        parent: the plan before, of one made in flight.
        without_uncertainty: the cheapest P3; None if planning began at a plan without one.
    """

    mission: Mission
    provenance: Provenance
    total_s: float
    starts: Starts | None = None
    parent: Parent | None = None
    without_uncertainty: WithoutUncertainty | None = None

    def __eq__(self, other: object) -> bool:
        """Whether another plan is the same but for the time it took."""
        if not isinstance(other, Plan):
            return NotImplemented
        return self._identity == other._identity

    def __hash__(self) -> int:
        """Hash of the burns."""
        return hash(self.final.result.lin.iterate.burns.tobytes())

    def __getstate__(self) -> dict[str, object]:
        """Its fields; a copy computes the cached arrays again, read-only too."""
        return {field.name: getattr(self, field.name) for field in fields(self)}

    @property
    def times_s(self) -> Array:
        """Times of the nodes past the epoch, s, shape (n,)."""
        return _read_only(self.mission.times_s.view())

    @cached_property
    def burns_m_s(self) -> Array:
        """Burns, J2000, m/s, shape (m, 3)."""
        return _read_only(self.final.result.lin.iterate.burns * self.mission.units.speed_m_s)

    @cached_property
    def states(self) -> Array:
        """Mean states at the nodes, J2000 and body-centred, m and m/s, shape (n, 6).

        After the burn where one falls on the node.
        """
        return _read_only(self.final.result.lin.iterate.mean * self.mission.units.state)

    @cached_property
    def covariances(self) -> Array:
        """Covariances at the nodes in the same units, shape (n, 6, 6)."""
        factor = self.final.result.lin.factor * self.mission.units.state[:, None]
        return _read_only(factor @ factor.transpose(0, 2, 1))

    @cached_property
    def parameter_covariances(self) -> Array:
        """Covariances of the states with the p numbers of the uncertain parameters, (n, 6, p)."""
        lin = self.final.result.lin
        factor = lin.factor * self.mission.units.state[:, None]
        return _read_only(factor @ lin.problem.parameter_factor.T)

    @cached_property
    def known(self) -> Array:
        """Covariances of the estimated states' errors at the nodes, shape (n, 6, 6).

        After the measurement and the burn there, if any. Without measurements they are `covariances`.
        """
        lin = self.final.result.lin
        factor = lin.flown_filter.error[:, :6] * self.mission.units.state[:, None]
        return _read_only(factor @ factor.transpose(0, 2, 1))

    @property
    def total_dv_m_s(self) -> float:
        """Sum of the burns' sizes, m/s."""
        return float(np.linalg.norm(self.burns_m_s, axis=1).sum())

    @property
    def cost_m_s(self) -> float:
        """The total delta-v as `policy.cost` counts it, which is minimised, m/s."""
        if self.commanded is None or self.counted == "nominal":
            return self.total_dv_m_s
        mean, most = self.commanded
        return mean if self.counted == "expected" else most

    @property
    def counted(self) -> Cost:
        """What `cost_m_s` is: `policy.cost`, or "nominal" with fixed burns."""
        feedback = self.final.result.lin.problem.feedback
        return "nominal" if feedback is None else feedback.cost

    @cached_property
    def commanded(self) -> tuple[float, float] | None:
        """Mean and 99 % quantile of the delta-v commanded in flight, m/s; None with fixed burns."""
        lin = self.final.result.lin
        if lin.problem.feedback is None:
            return None
        # Not as the program smooths them, which for a skewed law is up to 0.2 standard deviations low.
        total = self.mission.units.speed_m_s * total_sizes(lin.problem, lin.iterate)
        return float(total.mean()), float(np.quantile(total, PROBABILITY))

    @cached_property
    def worst_margins(self) -> dict[str, tuple[float, Unit]]:
        """The smallest margin of each constraint with its unit; >= 0 where it holds."""
        found: Named[tuple[float, Unit]] = Named()
        for name, margins in self.final.margins.items():
            unit = self.final.unit(name)
            found[name] = float(margins.margin.min()) * scales(self.mission.units)[unit], unit
        return found

    def __str__(self) -> str:
        """Status, delta-v, burns, margins and warnings."""
        scenario, outcome = self.mission.scenario, self.status.value
        problem = self.final.problem
        lines = [
            f"{scenario.name}, {problem}: {outcome.message}",
            f"total delta-v {self.total_dv_m_s:.6f} m/s, required p_chance {scenario.risk.p_chance:g}",
            "burn   time s      x m/s      y m/s      z m/s   size m/s",
        ]
        feedback = self.final.result.lin.problem.feedback
        if feedback is not None and self.commanded is not None:
            numbers = ", ".join(str(1 + scenario.burns_flown + burn) for burn in feedback.burns)
            mean, most = self.commanded
            said = f"commanded with feedback: mean {mean:.6f} m/s, 99 % {most:.6f} m/s"
            lines.insert(2, f"{said}; corrected burns: {numbers}")
        for number, (time, burn) in enumerate(
            zip(scenario.burn_times_s, self.burns_m_s, strict=True), start=1 + scenario.burns_flown
        ):
            cells = "".join(f" {component:+z10.6f}" for component in burn)
            cells += f" {np.linalg.norm(burn):10.6f}"
            lines.append(f"{number:4} {time:8g}{cells if burn.any() else 4 * NO_BURN}")
        lines.append(f"{'constraint':20} worst margin")
        lines += [
            f"{name:20} {round(margin, 4) + 0.0:+12.4f} {unit}"
            for name, (margin, unit) in self.worst_margins.items()
        ]
        if self.starts is not None:
            lines.append(f"{self.starts}; local optima, seed {self.starts.seed}")
            lines += [f"  {optimum}" for optimum in self.starts.optima]
        lines += [f"warning: {warning}" for warning in self.mission.warnings]
        return "\n".join(lines)

    def __repr__(self) -> str:
        """One line; only a `Solution` knows whether it is verified."""
        name, dv = self.mission.scenario.name, self.total_dv_m_s
        return f"<Plan {name}: {self.status.value.name}, {NOT_CHECKED}, {dv:.6f} m/s>"

    @property
    def _identity(self) -> tuple[object, ...]:
        runs = [
            (s.name, s.result.status, len(s.result.records), *_to_the_bit(s.result.lin.iterate))
            for s in (*self.stages, self.final)
        ]
        made = self.provenance, self.target, self.certificate, self.starts, self.parent
        return self.mission.scenario, made, runs


Aimed = TypeVar("Aimed", bound=StagedPlan)


def as_interrupted(plan: Aimed) -> Aimed:
    """The plan marked as interrupted: the best that was found when Ctrl-C came."""
    return ended(plan, Status.INTERRUPTED)


def ended(plan: Aimed, status: Status) -> Aimed:
    """The plan with another status."""
    result = replace(plan.final.result, status=status)
    return replace(plan, final=replace(plan.final, result=result))


def _to_the_bit(iterate: Iterate) -> tuple[bytes, bytes, bytes]:
    return iterate.burns.tobytes(), iterate.mean.tobytes(), iterate.gains.tobytes()


def _read_only(array: Array) -> Array:
    array.setflags(write=False)
    return array
