"""The primer's history in the solution file."""

from __future__ import annotations

import itertools
from typing import Annotated, Self

from pydantic import Field, model_validator

from scp_recon.solution.part import Part

Size = Annotated[float, Field(ge=-1e30, le=1e30)]


class Primer(Part):
    """Whether one more burn would help: a local certificate, at first order.

    Where no `allowed` at a time that is `legal` exceeds one, no small burn that is added makes the
    plan cheaper. J2000, at the nodes.
    """

    t_s: list[Size]
    vector: list[tuple[Size, Size, Size]]
    allowed: list[Size]
    legal: list[bool]
    residual: Annotated[float, Field(ge=0)]

    @model_validator(mode="after")
    def _fit_together(self) -> Self:
        columns = self.t_s, self.vector, self.allowed, self.legal
        if len({len(column) for column in columns}) != 1 or not self.t_s:
            raise ValueError("primer must have columns of one length")
        if any(b <= a for a, b in itertools.pairwise(self.t_s)):
            raise ValueError("primer.t_s must ascend")
        return self
