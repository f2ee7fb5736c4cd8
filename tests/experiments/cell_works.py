"""What stands for the solving of a cell; few modules, for the processes that run it."""

from __future__ import annotations

import os
from dataclasses import replace

from experiments.compare_solvers.cases import Cell
from experiments.compare_solvers.cell import Row, failed_row

FIGURES = ("total_dv_m_s", "merit_m_s", "heavy_merit_m_s", "violation_m", "total_s", "cpu_s")
FIGURES += ("solver_s", "peak_mib", "observed_s")


def fine(cell: Cell, flights: int) -> Row:
    figures = dict.fromkeys(FIGURES, float(flights))  # NaN is not even equal to itself
    return replace(failed_row(cell, ""), status="converged", problem="P2", **figures)


def raises(cell: Cell, flights: int) -> Row:
    raise ArithmeticError(f"nothing for {cell.seed} with {flights}")


def dies(cell: Cell, flights: int) -> Row:
    os._exit(7 + flights + 0 * cell.seed)


def works_for_ever(cell: Cell, flights: int) -> Row:
    while True:
        flights += cell.seed
