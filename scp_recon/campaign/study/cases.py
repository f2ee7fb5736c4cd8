"""The cases of a study: the product of its axes, each case made when it is asked for."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from math import prod
from typing import Any

import numpy as np

from scp_recon.campaign.rows.case import Case
from scp_recon.campaign.study.axes import Row


@dataclass(frozen=True)
class Cases(Sequence[Case]):
    """The product of the axes; the last one changes fastest. A case is made when it is asked for."""

    axes: tuple[list[Row], ...]
    seed: int

    def __len__(self) -> int:
        """How many there are."""
        return prod(len(rows) for rows in self.axes)

    def __getitem__(self, number: Any) -> Any:
        """The case of that number."""
        if not 0 <= number < len(self):
            raise IndexError(number)
        changes: Row = {}
        rest = number
        for rows in reversed(self.axes):
            rest, place = divmod(rest, len(rows))
            changes = {**rows[place], **changes}
        return Case(number, case_seed(self.seed, number), changes)


def case_seed(seed: int, number: int) -> int:
    """The seed of a case, from 0 to 2^63 - 1."""
    return int(np.random.SeedSequence((seed, number)).generate_state(1, np.uint64)[0] >> 1)
