"""Make the cases of a study, the product of its axes, and the scenario of each case."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from math import prod
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from scp_recon.jobs.job import sequence
from scp_recon.scenario.given import anchored, tables_of
from scp_recon.scenario.schema import Scenario

Changes = dict[str, Any]
"""Values by entry, set together: a row of an axis."""


class Case(NamedTuple):
    """A case of a study: its number from 0, its seed below 2^63, and values by dotted entry.

    Seed and values depend on the study and the number alone.
    """

    number: int
    seed: int
    changes: Mapping[str, Any]


@dataclass(frozen=True)
class Cases(Sequence[Case]):
    """The product of the axes, the last one changing fastest; each case is made on access."""

    axes: tuple[list[Changes], ...]
    seed: int

    def __len__(self) -> int:
        """Number of cases."""
        return prod(len(rows) for rows in self.axes)

    def __getitem__(self, number: Any) -> Any:
        """The case of that number."""
        if not 0 <= number < len(self):
            raise IndexError(number)
        changes: Changes = {}
        rest = number
        for rows in reversed(self.axes):
            rest, place = divmod(rest, len(rows))
            changes = {**rows[place], **changes}
        (state,) = sequence(self.seed, number).generate_state(1, np.uint64)
        return Case(number, int(state >> 1), changes)


SOLUTIONS = "solutions"
"""Folder of kept solutions in the campaign's."""


def solution_name(number: int) -> str:
    """Path of a case's kept solution, relative to the campaign's folder."""
    return f"{SOLUTIONS}/case-{number:07d}/solution.json"


TABLE = "campaign."
"""How entries of an axis begin that are of the campaign's table, not of the scenario."""


def of_campaign(changes: Mapping[str, Any]) -> Changes:
    """A case's changes to the table `[campaign]`, without its name."""
    return {key.removeprefix(TABLE): one for key, one in changes.items() if key.startswith(TABLE)}


def changed(base: Scenario, changes: Mapping[str, Any], folder: Path) -> Scenario:
    """Apply a case's changes to the base, but those to the campaign's table.

    Raises:
        InputError: if the result is no valid scenario.
    """
    own = {entry: value for entry, value in changes.items() if not entry.startswith(TABLE)}
    return base.changed(layer_of(own, folder)) if own else base


def layer_of(changes: Mapping[str, Any], folder: Path) -> dict[str, Any]:
    """Nested tables of values by entry, the paths of files among them made absolute."""
    return anchored(tables_of(changes.items()), folder)
