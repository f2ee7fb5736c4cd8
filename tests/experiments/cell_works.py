"""Stand-ins for the solving of a cell; few modules, for the process that runs it."""

from __future__ import annotations

from experiments.compare_solvers.cases import Cell
from experiments.compare_solvers.cell import Row


def works_for_ever(cell: Cell, flights: int) -> Row:
    while True:
        flights += cell.seed
