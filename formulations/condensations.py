"""The ways to eliminate mean and factor, by the name of the formulation."""

from __future__ import annotations

from typing import Protocol

from formulations.frozen_covariance import condense_frozen_covariance
from formulations.frozen_stm import condense_frozen_stm
from formulations.lifting import Linearisation, Sensitivity, condense
from formulations.problem import Nodes


class Condensation(Protocol):
    """Mean and factor at some nodes as affine functions of the burns."""

    def __call__(self, lin: Linearisation, nodes: Nodes, *, factor: bool) -> Sensitivity:
        """See `formulations.lifting.condense`."""
        ...


CONDENSATIONS: dict[str, Condensation] = {
    "condensed": condense,
    "frozen-stm": condense_frozen_stm,
    "frozen-covariance": condense_frozen_covariance,
}
