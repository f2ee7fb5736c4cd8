"""How the stages of a plan follow each other, whatever solves them: P3, P2, and both begun again."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from time import perf_counter
from typing import Literal, Protocol

from formulations.facets import Facets
from formulations.problem import Iterate
from formulations.program.subproblem import Evaluation
from scp_recon.errors import InputError
from scp_recon.guess import ballistic, circular
from scp_recon.mission import Mission
from scp_recon.scp import Record, Result, Timing
from scp_recon.scvx import TrustRegion
from scp_recon.status import Status

Observer = Callable[[str, Record], None]

OTHER_OPTIMUM = 0.999
"""Share of a merit below which another run has found another optimum."""


@dataclass(frozen=True)
class Stage:
    """A run of the SCP, or of IPOPT, on one problem.

    Attributes:
        name: "P3", "P2", "P2.2" with the facets chosen a second time, ...; "P3b", "P2b", ... of those
            that began again at the ballistic arc, c and d at a turn about the body.
        result: how it ended and where.
        subproblem: of which it was; it knows the constraints' margins.
        facets: of P2, None for P3.
        tolerance: violation that counted as none.
    """

    name: str
    result: Result
    subproblem: Evaluation
    facets: Facets | None
    tolerance: float

    @property
    def begun_again(self) -> bool:
        """Whether it began elsewhere because the guess led nowhere."""
        return self.name[2:3] in ("b", "c", "d")


@dataclass(frozen=True)
class Plan:
    """All stages of planning a mission; the one in `stages` that `final` names holds the answer."""

    mission: Mission
    stages: tuple[Stage, ...]
    final: Stage
    timing: Timing
    total_s: float


class StageSolver(Protocol):
    """What solves single stages, and keeps those that it solved; Ctrl-C raises KeyboardInterrupt."""

    mission: Mission
    stages: list[Stage]
    timing: Timing

    def solve_p3(self, guess: Iterate, name: str) -> Stage:
        """P3 from a guess."""
        ...

    def solve_p2(self, start: Stage, name: str) -> Stage:
        """P2 from where a stage ended, with the facets chosen there."""
        ...


def solve_in_stages(solver: StageSolver, guess: Iterate, problem: Literal["P3", "P2"]) -> Stage:
    """P3 from a guess and P2 from there.

    Where P3 does not converge from the guess it is tried again from other starts; and so it is where
    P2 does not converge, because P3 may have stopped at a local optimum from which there is no way.
    The best of the tries counts. Facets that leave even it nothing feasible are chosen again, where
    it ended.
    """
    firsts: list[Stage] = []
    finals: list[Stage] = []
    for letter, start in _starts(solver.mission, guess):
        p3 = solver.solve_p3(start, f"P3{letter}")
        known = any(_same_optimum(p3, other) for other in firsts)
        firsts.append(p3)
        if p3.result.status is not Status.CONVERGED or known:
            continue
        finals.append(p3 if problem == "P3" else solver.solve_p2(p3, f"P2{letter}"))
        if finals[-1].result.status is Status.CONVERGED:
            break
    if not finals:
        p3 = _best(firsts)
        lost = problem == "P3" or p3.result.status is Status.SOLVER_FAILED
        finals.append(p3 if lost else solver.solve_p2(p3, p3.name.replace("P3", "P2")))
    best = _best(finals)
    if best.facets is None or best.result.status is not Status.INFEASIBLE:
        return best
    return _best([best, solver.solve_p2(best, f"{best.name}.2")])


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


def _same_optimum(one: Stage, other: Stage) -> bool:
    """Whether two runs of P3 ended alike."""
    low, high = sorted((_merit(one), _merit(other)))
    return one.result.status is other.result.status and low > OTHER_OPTIMUM * high


def _best(stages: list[Stage]) -> Stage:
    best = stages[0]
    for stage in stages[1:]:
        best = stage if better(stage, best) else best
    return best


def finish(solver: StageSolver, work: Callable[[], Stage]) -> Plan:
    """Do it; an interrupted plan ends with the best stage so far, if there is one."""
    started = perf_counter()
    try:
        final = work()
    except KeyboardInterrupt:
        if not solver.stages:
            raise
        final = _interrupted(solver.stages)
    seconds = perf_counter() - started
    return Plan(solver.mission, tuple(solver.stages), final, solver.timing, seconds)


def _interrupted(stages: list[Stage]) -> Stage:
    """The best stage so far, marked as interrupted: one that converged on P2 before any other."""
    solved = [s for s in stages if s.facets and s.result.status is Status.CONVERGED]
    best = (solved or stages)[-1]
    if best.facets is None:
        best = min(stages, key=_merit)
    return replace(best, result=replace(best.result, status=Status.INTERRUPTED))


def better(new: Stage, old: Stage) -> bool:
    """Whether a run is worth keeping instead: first by how it ended, then cheaper."""
    if _rank(new) != _rank(old):
        return _rank(new) > _rank(old)
    return _merit(new) < _merit(old)


def _rank(stage: Stage) -> int:
    """How much a run's end says: a solution, a point that violates nothing, any other, nothing."""
    if stage.result.status is Status.CONVERGED:
        return 3
    if _violated(stage) <= stage.tolerance:
        return 2
    return 0 if stage.result.status is Status.SOLVER_FAILED else 1


def _violated(stage: Stage) -> float:
    violations = stage.subproblem.violations(stage.result.lin)
    return max(float(amount.max(initial=0.0)) for amount in violations.values())


def _merit(stage: Stage) -> float:
    return stage.subproblem.merit(stage.result.lin, TrustRegion().weight)
