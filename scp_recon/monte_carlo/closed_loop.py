"""Correct the burns of flights under way: measure, estimate, and command by a policy's gains."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from functools import cached_property

import numpy as np

from formulations.arrays import Array, Booleans
from formulations.problem.flyby import Iterate
from scp_recon.mission.mission import Mission
from scp_recon.planning.initial_guess import from_burns
from scp_recon.results.policy import CutOff, Policy, transition

MEASURED = 6
"""Standard normal numbers that a measurement draws."""


def due(policy: Sequence[CutOff], after_s: float, until_s: float) -> Iterator[float]:
    """The cut-offs of a policy after one time and up to another."""
    for one in policy:
        if after_s < one.cut_off_s <= until_s:
            yield one.cut_off_s


class ClosedLoop:
    """Estimates and corrections of flights under way; J2000, m and m/s, deviations from the plan.

    Args:
        mission: that is flown.
        burns_m_s: planned, shape (m, 3).
        policy: that corrects them.
        draws: standard normal numbers of the measurements, shape (flights, 6 k).

    Attributes:
        failed: empty: corrections cannot fail.
    """

    failed: Sequence[Booleans] = ()

    def __init__(self, mission: Mission, burns_m_s: Array, policy: Policy, draws: Array) -> None:
        self._mission, self._burns, self._policy = mission, burns_m_s, policy
        self._draws = draws.reshape(len(draws), len(policy), MEASURED)
        self._estimates: list[Array] = []  # after each cut-off so far, shape (6, flights)

    def measure(self, state: Array) -> None:
        """Update the estimates at the next cut-off from true states (6, flights) before a burn."""
        j = len(self._estimates)
        one = self._policy[j]
        predicted = self._predicted(j)
        innovation = state - self._planned(j)[:, None] + one.noise(self._draws[:, j]) - predicted
        self._estimates.append(predicted + one.kalman_gain @ innovation)

    def correction(self, burn: int) -> Array | None:
        """Correction of a planned burn, shape (flights, 3); None if it has no gains."""
        for one in self._policy:
            if one.burn == burn and one.gains.any():
                known = zip(one.gains, self._estimates, strict=False)
                return np.asarray(sum(gain @ estimate for gain, estimate in known).T)
        return None

    def _predicted(self, j: int) -> Array:
        """The estimate just before a cut-off, shape (6, flights)."""
        node = self._node(j)
        predicted = np.zeros((MEASURED, len(self._draws)))
        if j == 0:
            return predicted
        before = self._node(j - 1)
        predicted += self._carried(before, node) @ self._estimates[j - 1]
        for one in self._policy[:j]:
            fired = int(self._mission.burn_nodes[one.burn])
            correction = self.correction(one.burn)
            if before <= fired < node and correction is not None:
                predicted += self._carried(fired, node)[:, 3:] @ correction.T
        return predicted

    def _node(self, j: int) -> int:
        return int(np.searchsorted(self._mission.times_s, self._policy[j].cut_off_s))

    def _planned(self, j: int) -> Array:
        """The planned state at a cut-off, before a burn there."""
        node, state = self._node(j), self._states[self._node(j)].copy()
        state[3:] -= self._burns[self._mission.burn_nodes == node].sum(axis=0)
        return np.asarray(state)

    def _carried(self, first: int, last: int) -> Array:
        """The plan's state-transition matrix between two nodes, in SI."""
        units = self._mission.units.state
        return np.asarray(units[:, None] * transition(self._stm, first, last) / units)

    @cached_property
    def _states(self) -> Array:
        """The planned states at the nodes, after the burns, shape (n, 6)."""
        return np.asarray(self._iterate.mean * self._mission.units.state)

    @cached_property
    def _iterate(self) -> Iterate:
        return from_burns(self._mission, self._burns)

    @cached_property
    def _stm(self) -> Array:
        """State-transition matrices of the arcs, shape (n - 1, 6, 6), nondimensional."""
        mission = self._mission
        return np.asarray(
            mission.dynamics.linearise(mission.problem.open_loop, self._iterate).arcs.stm
        )
