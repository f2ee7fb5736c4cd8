"""A row of the comparison's table."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from experiments.compare_solvers.cases import Cell, Method
from scp_recon.scp.status import Status

FAILED = "failed"
"""Status of a cell that did not come to an end of its own."""


@dataclass(frozen=True)
class Row:
    """A cell and what came of it; empty figures are NaN.

    Attributes:
        key, group, scenario, start, seed, formulation, algorithm, solver: the cell.
        status: a `Status` by name, or `FAILED`.
        detail: why it failed.
        problem: "P2", or "P3" where that was not solved.
        total_dv_m_s: sum of the burns.
        merit_m_s: with the exact penalty of SCvx, first weight; IPOPT's burns are flown first, because
            gaps between its arcs cost next to nothing there.
        heavy_merit_m_s: with its second weight, which infeasible cases end with.
        violation_m: largest violation; velocities count as metres per unit of time. With exact risk it
            is of the final state and of the limits on the burns alone.
        iterations_p3, iterations_p2: the latter over all facet restorations; evaluations of the
            references of exact risk.
        first_status: of the first try, where another was made.
        from_arc: whether the answer is that of a later try, from the ballistic arc or a turn.
        total_s: from the guess, or from SCP's P3 solution, to the end; programs are built in it, but
            nothing is imported.
        cpu_s: of the processor in that time, which other work on the machine does not lengthen.
        solver_s: in the conic solver, or in IPOPT without its evaluations.
        peak_mib: resident memory of the process, imports included.
        observed_s: mean observation time of many flights.
        burns_m_s: all components.
        asked: probability, of exact risk.
        reached: what the check finds of it, at the worst node or of whole flights.
        reached_error: its standard error.
        limit_s: seconds of the processor that it was allowed.
        version: of the sources that solved it.
    """

    key: str
    group: str
    scenario: str
    start: str
    seed: int
    formulation: str
    algorithm: str
    solver: str
    status: str
    detail: str = ""
    problem: str = ""
    total_dv_m_s: float = np.nan
    merit_m_s: float = np.nan
    heavy_merit_m_s: float = np.nan
    violation_m: float = np.nan
    iterations_p3: int = 0
    iterations_p2: int = 0
    first_status: str = ""
    from_arc: bool = False
    total_s: float = np.nan
    cpu_s: float = np.nan
    solver_s: float = np.nan
    peak_mib: float = np.nan
    observed_s: float = np.nan
    burns_m_s: tuple[float, ...] = ()
    asked: float = np.nan
    reached: float = np.nan
    reached_error: float = np.nan
    limit_s: float = np.nan
    version: str = ""

    @property
    def method(self) -> str:
        """Name of the method."""
        return Method(self.formulation, self.algorithm, self.solver).name

    @property
    def solved_at_once(self) -> bool:
        """Whether it was solved at the first try."""
        return self.solved and not self.first_status

    @property
    def solved(self) -> bool:
        """Whether P2 converged and every constraint holds."""
        return self.problem == "P2" and self.status == Status.CONVERGED.value.name


def failed_row(cell: Cell, reason: str, cpu_s: float = np.nan) -> Row:
    """The row of a cell that did not come to an end of its own."""
    return replace(empty_row(cell), detail=reason, cpu_s=cpu_s)


def empty_row(cell: Cell) -> Row:
    """A row without figures."""
    method = cell.method
    return Row(
        key=cell.key,
        group=cell.group,
        scenario=cell.scenario,
        start=cell.start,
        seed=cell.seed,
        formulation=method.formulation,
        algorithm=method.algorithm,
        solver=method.solver,
        status=FAILED,
    )
