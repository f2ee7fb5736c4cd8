"""Run a plan's stages by any method: P3, P2, and both again from other starts.

A keep-out set is linearised by the plane that touches it nearest to the iterate, so that an iterate
stays on its side. The path of a guess that is no flight says nothing about sides. P3 then begins with a
first stage without the keep-out sets of a part of the flight, whose answer hardly depends on the guess,
and continues with all of them, on the side nearest to that answer. Without them an answer costs at most
what any plan with them does, so that if it keeps them there is nothing better near it.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from time import perf_counter
from typing import Literal, Protocol

import numpy as np

from formulations.arrays import Array, Booleans
from formulations.linearisation.dynamics import Dynamics
from formulations.linearisation.linearisation import Linearisation
from formulations.problem.facets import Facets, choose_facets
from formulations.problem.flyby import FlybyProblem, Iterate
from formulations.program.subproblem import MeritFunction
from formulations.rows.cones import Rows
from formulations.rows.uniform import ChanceRows, DeterministicRows
from scp_recon.errors import InputError
from scp_recon.mission.mission import Mission
from scp_recon.planning.initial_guess import ballistic, circular, from_burns
from scp_recon.planning.plan import Plan, Provenance, Stage
from scp_recon.scenario.fields import ScenarioWarning
from scp_recon.scp.algorithms import SCvx
from scp_recon.scp.loop import Record, Timing
from scp_recon.scp.status import Status

OTHER_OPTIMUM = 0.999
"""Ratio of two merits below which the runs ended at different optima."""

OTHER_BURNS = 1e-2
"""Difference of a burn component, nondimensional, above which they did so too."""

FIRST_STAGE = ".open"
"""Suffix of the stage that leads to a P3 whose guess is no flight."""

HELD_STAGE = ".held"
"""Suffix of a stage in which burns are held that would be too small to execute."""

RESOLVED = 1e-6
"""Relative difference of two merits that stages leave open."""

NEITHER = "and neither is a plan"
"""End of the warning of burns that stay too small."""

TINY = 1e-300
"""Stands for zero in a quotient."""

RESOLUTION = 1e-3
"""Relative reduction of the merit at which the first stage stops: P3 goes on from there."""

NO_BURN = 1e-6
"""Total delta-v, nondimensional, below which a guess has no burns that could be wrong."""

CHOICES_MAX = 4
"""Further choices of facets before P2 is called infeasible, where there is another choice."""

Observer = Callable[[str, Record], None]


class RowsSolver(Protocol):
    """Solves P3 or P2 on one set of rows: the only difference between SCP's and IPOPT's plans."""

    @property
    def p3_rows(self) -> DeterministicRows:
        """P3's constraints."""

    @property
    def first_stage_rows(self) -> DeterministicRows | None:
        """Rows that P3 begins with where its guess is no flight; None if it begins with all."""

    def p2_rows(self, facets: Facets, lin: Linearisation) -> ChanceRows:
        """P2's constraints on given facets; the program includes those near an iterate."""

    def exact_rows(self) -> Sequence[tuple[str, Rows]]:
        """P2's constraints with the true probabilities, one stage leading to the next, by name.

        Raises:
            InputError: if the method has no such rows.
        """

    def solve(
        self, name: str, rows: Rows, start: Linearisation, dynamics: Dynamics, observe: Observer
    ) -> Stage:
        """Solve a stage from a start; its status says if it was interrupted."""


@dataclass
class StageRunner:
    """State of one planning run: stages and timings so far. For `facet_rounds` see `Planner.plan`."""

    mission: Mission
    solver: RowsSolver
    observe: Observer | None = None
    facet_rounds: int = 0
    choices: int = CHOICES_MAX
    stages: list[Stage] = field(default_factory=list)
    timing: Timing = field(default_factory=Timing)
    _chosen: dict[str, int] = field(default_factory=dict)

    def run(self, work: Callable[[], Stage], provenance: Provenance) -> Plan:
        """Run the stages of a plan; an interrupted one ends with the best stage so far, if any."""
        started = perf_counter()
        try:
            final = work()
        except KeyboardInterrupt:
            if not self.stages:
                raise
            final = _interrupted(self.stages)
        seconds = perf_counter() - started
        return Plan(self.mission, provenance, tuple(self.stages), final, self.timing, seconds)

    def plan(self, guess: Iterate, problem: Literal["P3", "P2"], *, once: bool = False) -> Stage:
        """Solve P3 from a guess, after a first stage if it is no flight, and P2 from there.

        If P3 does not converge from the guess, it is tried from other starts, and also if P2 does not:
        P3 may have stopped at a bad local optimum. If none converges, the facets are chosen again. The
        best of all tries counts. With `once` there is no other start.
        """
        if problem == "P2" and self.mission.scenario.risk.allocation == "exact":
            self.solver.exact_rows()  # a method that has none says so before any work
        firsts: list[Stage] = []
        finals: list[Stage] = []
        for letter, start in [("", guess)] if once else _starts(self.mission, guess):
            p3 = self._solve_p3(f"P3{letter}", self.start(start))
            known = any(same_optimum(p3, other) for other in firsts)
            firsts.append(p3)
            if p3.result.status is not Status.CONVERGED or known:
                continue
            finals.append(p3 if problem == "P3" else self._solve_p2(f"P2{letter}", p3))
            if finals[-1].result.status is Status.CONVERGED:
                return finals[-1]
        if not finals:
            p3 = max(firsts, key=standing)
            lost = problem == "P3" or p3.result.status is Status.SOLVER_FAILED
            finals.append(p3 if lost else self._solve_p2(p3.name.replace("P3", "P2"), p3))
        for final in [final for final in finals if final.facets]:
            finals.append(self.choose_again(final))
            if finals[-1].result.status is Status.CONVERGED:
                break
        return max(finals, key=standing)

    def flown(self, last: Plan) -> Iterate:
        """Burns and gains of a plan on this mission's nodes."""
        mission, gains = self.mission, last.final.result.lin.iterate.gains
        return replace(from_burns(mission, last.burns_m_s), gains=gains)

    def go_on(self, last: Plan) -> Stage | None:
        """Solve P2 with exact risk from a plan, without the stages that lead to one.

        Returns:
            The stage; None if it did not converge, or if risk is not exact.
        """
        if self.mission.scenario.risk.allocation != "exact":
            return None
        _, rows = self.solver.exact_rows()[-1]
        start = self.mission.dynamics.linearise(rows.problem, self.flown(last))
        stage = self.solve("P2", rows, start)
        return stage if stage.result.status is Status.CONVERGED else None

    def choose_again(self, stage: Stage) -> Stage:
        """The best of P2 with facets chosen where the last try ended, until one converges.

        That some facets leave nothing feasible says little about others; a few choices settle it. A
        try that ends without a verdict does not count.
        """
        name, tries = stage.name.partition(".")[0], [stage]
        while tries[-1].result.status is Status.INFEASIBLE and len(tries) <= self.choices:
            last = [s for s in self.stages if s.name.partition(".")[0] == name][-1]
            tries.append(self._with_facets(name, last.result.lin))
        verdicts = (Status.CONVERGED, stage.result.status)
        return max((one for one in tries if one.result.status in verdicts), key=standing)

    def executable(self, stage: Stage) -> Stage:
        """The stage solved again without burns too small to execute, or with some of them raised.

        Burns between zero and `burns.dv_min_m_s` are held at zero while the others are planned again.
        No choice can cost less than the stage itself. Where that one costs more, each burn in turn, the
        largest first, is kept at that size or above, if that is better; where that leads to no plan,
        all are. Where nothing is a plan they stay, with a warning.
        """
        self.mission = _without_words_on_burns(self.mission)
        while stage.result.status is Status.CONVERGED:
            sizes = self._sizes(stage)
            small = (sizes > 0.0) & (sizes < self._dv_min)
            small[list(stage.result.lin.problem.raised)] = False
            if not small.any():
                break
            raised = np.zeros_like(small)
            best = self._with_burns(stage, small, raised)
            for burn in sorted(np.flatnonzero(small), key=lambda i: -sizes[i]):
                if not _clearly_better(stage, best):
                    break
                raised[burn] = True
                other = self._with_burns(stage, small, raised)
                raised[burn] = _clearly_better(other, best)
                best = other if raised[burn] else best
            if best.result.status is not Status.CONVERGED and not raised[small].all():
                best = self._with_burns(stage, small, small)
            if best.result.status is not Status.CONVERGED:
                self._warn_of(small, sizes)
                break
            stage = best
        return stage

    @staticmethod
    def _sizes(stage: Stage) -> Array:
        """Root mean square of the burns' commanded sizes, shape (m,)."""
        problem, iterate = stage.result.lin.problem, stage.result.lin.iterate
        sizes = np.linalg.norm(iterate.burns, axis=1)
        if problem.feedback is not None:
            for j, burn in enumerate(problem.feedback.burns):
                sizes[burn] = np.hypot(sizes[burn], np.linalg.norm(problem.gains_of(iterate, j)))
        return np.asarray(sizes)

    @property
    def _dv_min(self) -> float:
        """The smallest burn that is executed, in the mission's units."""
        return self.mission.scenario.burns.dv_min_m_s / self.mission.units.speed_m_s

    def _with_burns(self, stage: Stage, small: Booleans, raised: Booleans) -> Stage:
        """A stage again, its small burns held at zero, but for those that are raised."""
        dynamics, at = self.mission.dynamics, stage.result.lin.problem
        iterate, least = stage.result.lin.iterate, self._dv_min
        sizes = np.linalg.norm(iterate.burns, axis=1, keepdims=True)
        scale = np.where(raised[:, None], least / np.maximum(sizes, TINY), ~small[:, None])
        burns = scale * iterate.burns
        gains = at.without_corrections(iterate.gains, np.flatnonzero(small & ~raised))
        problem = replace(
            at,
            held=tuple(np.flatnonzero(~burns.any(axis=1)).tolist()),
            raised=(*at.raised, *np.flatnonzero(raised).tolist()),
            dv_min=least,
        )
        flown = Iterate(burns, dynamics.rollout(at.initial_state, burns), gains)
        start = dynamics.linearise(problem, flown)
        name, rows = f"{stage.name.removesuffix(HELD_STAGE)}{HELD_STAGE}", stage.merit.rows
        if isinstance(rows, ChanceRows):
            return self.restore(name, rows, start)
        return self.solve(name, rows, start)

    def _warn_of(self, small: Booleans, sizes: Array) -> None:
        """Say which burns are smaller than the smallest that is executed, and stay."""
        mission = self.mission
        first, speed = 1 + mission.scenario.burns_flown, mission.units.speed_m_s
        said = (f"burn {first + i} of {speed * sizes[i]:.1e} m/s" for i in np.flatnonzero(small))
        word = ScenarioWarning.of(
            "burns.dv_min_m_s",
            ", ".join(said),
            f"expected none or {mission.scenario.burns.dv_min_m_s:g} m/s, {NEITHER}",
        )
        self.mission = replace(mission, warnings=(*mission.warnings, word))

    def start(self, guess: Iterate) -> Linearisation:
        """Linearise at a guess, moved to the problem's initial state."""
        problem, mean = self.mission.problem.open_loop, guess.mean.copy()
        mean[0] = problem.initial_state
        if not problem.coasts:
            mean[0, 3:] += guess.burns[0]
        return self.mission.dynamics.linearise(problem, Iterate(guess.burns, mean))

    def _solve_p3(self, name: str, start: Linearisation) -> Stage:
        """Solve P3, after a first stage if the start is no flight; all rows judge both."""
        rows, first = self.solver.p3_rows, self.solver.first_stage_rows
        if first is not None and contradicts_itself(start):
            stage = self.solve(f"{name}{FIRST_STAGE}", first, start, rows)
            start = stage.result.lin
        return self.solve(name, rows, start)

    def _solve_p2(self, name: str, start: Stage) -> Stage:
        """Solve P2 from the end of a stage, and again with new facets as long as that helps."""
        if self.mission.scenario.risk.allocation == "exact":
            return self.solve_exact(name, start.result.lin)
        final = self._with_facets(name, start.result.lin)
        for _ in range(self.facet_rounds):
            again = self._with_facets(name, final.result.lin)
            if not standing(again) > standing(final):
                break
            final = again
        return final

    def solve_exact(self, name: str, lin: Linearisation) -> Stage:
        """Solve P2 with the true probabilities, after quicker stages as long as they converge."""
        feedback = self.mission.problem.feedback
        for way, rows in self.solver.exact_rows():
            stage = self.solve(name + way, rows, lin)
            lin = stage.result.lin
            # What has no plan open loop may have one with corrections.
            if stage.result.status is not Status.CONVERGED and rows.problem.feedback is feedback:
                break
        return stage

    def _with_facets(self, name: str, lin: Linearisation) -> Stage:
        """Solve P2 with facets chosen at the start; the name gets the number of the choice."""
        mission, chosen = self.mission, self._chosen
        chosen[name] = chosen.get(name, 0) + 1
        name = name if chosen[name] == 1 else f"{name}.{chosen[name]}"
        facets = choose_facets(mission.problem, mission.polytopes, lin.iterate.mean, lin.factor)
        return self.restore(name, self.solver.p2_rows(facets, lin), lin)

    def restore(self, name: str, rows: ChanceRows, lin: Linearisation) -> Stage:
        """Solve P2, and again with facets that were left out of the program and are violated."""
        while True:
            stage = self.solve(name, rows, lin)
            lin = stage.result.lin
            missed = rows.missed(lin, stage.tolerance)
            if not missed.any():
                return stage
            rows = ChanceRows(self.mission.problem, rows.facets, rows.included | missed)

    def solve(
        self, name: str, rows: Rows, start: Linearisation, judges: Rows | None = None
    ) -> Stage:
        """Solve one stage, judged by `judges`, by default its own rows.

        Raises:
            KeyboardInterrupt: if it was interrupted.
        """
        observe = self.observe or (lambda *_: None)
        start = start.known(rows.problem.feedback)
        stage = self.solver.solve(name, rows, start, self.mission.dynamics, observe)
        if judges is not None:
            stage = replace(stage, merit=MeritFunction(self.mission.problem, judges))
        self.stages.append(stage)
        self.timing.add(stage.result.timing)
        if stage.result.status is Status.INTERRUPTED:
            raise KeyboardInterrupt
        return stage


def _without_words_on_burns(mission: Mission) -> Mission:
    """The mission without warnings that an earlier plan's burns stayed too small."""
    kept = tuple(word for word in mission.warnings if not word.expected.endswith(NEITHER))
    return replace(mission, warnings=kept)


def _starts(mission: Mission, guess: Iterate) -> Iterator[tuple[str, Iterate]]:
    """The guess, the ballistic arc if there is one, and a turn about the body either way.

    A straight line may pass through the body's centre, where nothing can be linearised.
    """
    yield "", guess
    try:
        arc = ballistic(mission)
    except InputError:
        pass
    else:
        yield "b", arc
    yield "c", circular(mission, 1.0)
    yield "d", circular(mission, -1.0)


def contradicts_itself(lin: Linearisation) -> bool:
    """Whether a guess has burns, but its path has larger velocity defects than these.

    A coarse trajectory of another tool does not contradict itself, nor does a path without burns, such
    as the paper's straight line.
    """
    kicks = float(np.linalg.norm(lin.defects[:-1, 3:], axis=1).sum())
    return NO_BURN < lin.iterate.total_dv < kicks


def without_parting_sets(problem: FlybyProblem) -> FlybyProblem:
    """The problem without the keep-out sets of a part of the flight.

    Sets of the whole flight stay: they keep the path away from the dynamics' singularity.
    """
    kept = [c for c in problem.constraints if c.keep == "in" or len(c.nodes) == problem.n_nodes]
    return replace(problem, constraints=tuple(kept))


def same_optimum(one: Stage, other: Stage) -> bool:
    """Whether two runs of P3 ended at the same optimum."""
    low, high = sorted((_merit(one), _merit(other)))
    apart = np.abs(one.result.lin.iterate.burns - other.result.lin.iterate.burns).max()
    alike = low > OTHER_OPTIMUM * high and bool(apart < OTHER_BURNS)
    return one.result.status is other.result.status and alike


def _interrupted(stages: list[Stage]) -> Stage:
    """The best stage so far, marked as interrupted: one that converged on P2 before any other."""
    whole = [stage for stage in stages if not stage.name.endswith(FIRST_STAGE)]
    p2 = [stage for stage in whole if stage.problem == "P2"]
    best = max(p2 or whole or stages, key=standing)
    return replace(best, result=replace(best.result, status=Status.INTERRUPTED))


def standing(stage: Stage) -> tuple[int, float]:
    """Rank of a run, the better the greater: by how it ended, then by cost.

    It ended solved (3), at a point that violates nothing (2), otherwise (1), or without an answer of
    the solver (0).
    """
    rank = 0 if stage.result.status is Status.SOLVER_FAILED else 1
    if stage.result.status is Status.CONVERGED:
        rank = 3
    elif stage.merit.worst_violation(stage.result.lin) <= stage.tolerance:
        rank = 2
    return rank, -_merit(stage)


def _clearly_better(one: Stage, other: Stage) -> bool:
    """Whether a run ranks above another by more than stages leave open."""
    rank, merit = standing(one)
    return (rank, merit * (1.0 + RESOLVED)) > standing(other)


def _merit(stage: Stage) -> float:
    return stage.merit(stage.result.lin, SCvx().weight)
